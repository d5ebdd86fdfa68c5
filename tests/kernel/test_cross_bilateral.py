"""The kernel: gradcheck of the reference, and the compiled variants against it, values and every gradient."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.kernel import ALWAYS, EVERY_SET, TOLERANCE, Terms, make_guides, make_raw, names, single, worst
from helpers.tolerances import near
from torch import Tensor

from selfcorrect.buffers import TERMS
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.exposure import LARGEST
from selfcorrect.kernel import _cpu
from selfcorrect.kernel.backend import BACKENDS, instruction_sets
from selfcorrect.kernel.cross_bilateral import Window, cpu, cross_bilateral, cross_bilateral_loss, gpu, reference
from selfcorrect.kernel.guides import Guides

SINGLE = TOLERANCE[torch.float32]
BACKENDS_AND_SETS = [*instruction_sets(), "gpu"]
"""The CPU's compiled variants, and the one for CUDA: in Triton's interpreter where there is no device."""

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRETED = DEVICE == "cpu"
TILE = (16, 32) if INTERPRETED else gpu.TILE  # the interpreter takes as long for a large one as for a small one
ORIGIN = torch.zeros(1, 2, dtype=torch.int64)
exact = partial(reference.cross_bilateral, taps_per_step=None)
every_set = pytest.mark.parametrize("terms", EVERY_SET, ids=names)


def sides(usual: tuple[int, ...], interpreted: tuple[int, ...]) -> pytest.MarkDecorator:
    """Every backend with windows of these sides; the interpreter, at 40 ms a tap, with those that it can bear."""
    cases = [(b, s) for b in BACKENDS_AND_SETS for s in (interpreted if b == "gpu" and INTERPRETED else usual)]
    return pytest.mark.parametrize(("backend", "side"), cases)


def patches(backend: str, *corners: tuple[int, int]) -> Tensor:
    """Corners (N, 2); for the interpreter, which takes patches one after the other, the last one."""
    return torch.tensor(corners[-1:] if backend == "gpu" and INTERPRETED else corners)


def leaf(backend: str, raw: Tensor) -> Tensor:
    """The heads in float32, to be differentiated, where the backend wants them."""
    return raw.float().to(DEVICE if backend == "gpu" else "cpu").requires_grad_()


def compare(guides: Guides, raw: Tensor, corners: Tensor, window: Window, backend: str, case: str = "") -> None:
    """Values and the gradient of every head, under a random upstream gradient."""
    expected_raw = raw.clone().requires_grad_()
    expected = exact(guides, expected_raw, corners, window)
    upstream = torch.randn(expected.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (expected * upstream).sum().backward()

    got_raw = leaf(backend, raw)
    if backend == "gpu":
        got = gpu.cross_bilateral(single(guides, DEVICE), got_raw, corners, window, tile=TILE)
    else:
        got = cpu.cross_bilateral(single(guides), got_raw, corners, window, threads=2, isa=backend)
    (got * upstream.float().to(got.device)).sum().backward()
    assert_close("g", got, expected, "cross-bilateral extreme" if case == "extreme" else "cross-bilateral")
    if case == "saturated":
        parts = [raw.grad.tensor_split([guides.betas], 1) for raw in (got_raw, expected_raw)]
        of_scales, of_others = zip(*parts, strict=True)
        assert_close("scales", *of_scales, "cross-bilateral saturated scales")
        assert_heads_close(*of_others, "cross-bilateral saturated gradients")
    else:
        assert_heads_close(got_raw.grad, expected_raw.grad, "cross-bilateral gradients")


def assert_close(name: str, got: Tensor, expected: Tensor, kind: str) -> None:
    difference = worst(got, expected)
    assert difference < SINGLE[kind], f"{name}: off by {difference:.2e} of the maximum"


def assert_heads_close(got: Tensor, expected: Tensor, kind: str) -> None:
    for head in range(expected.shape[1]):
        assert_close(f"head {head}", got[:, head], expected[:, head], kind)


@pytest.mark.parametrize("combination", ["eq10", "eq3"])
@every_set
def test_reference_gradcheck(terms: Terms, combination: str) -> None:
    guides = make_guides(5, 6, terms)
    raw = make_raw(guides, combination, (2, 3, 3)).requires_grad_()
    corners = torch.tensor([[0, 0], [3, -2]])
    window = Window(3, combination=combination)
    assert torch.autograd.gradcheck(lambda raw: exact(guides, raw, corners, window), raw)


def test_reference_by_hand() -> None:
    """Eqs. 10 and 11 with plain loops, at one pixel."""
    guides = make_guides(7, 7)
    raw = make_raw(guides, "eq10", (1, 7, 7))
    got = exact(guides, raw, ORIGIN, Window(5))[0, :, 1, 2]
    beta = torch.tanh(raw[0, :9, 1, 2]).reshape(3, 3)
    gamma = torch.log1p(torch.exp(raw[0, 9:14, 1, 2]))
    tau = torch.log1p(torch.exp(raw[0, 14, 1, 2])) + 1e-4

    def pixel(row: int, column: int) -> dict[str, Tensor]:
        p = guides.planes[:, guides.margin + row, guides.margin + column]
        return {"y": p[:3], "albedo": p[3:6], "visibility": p[6:7], "normal": p[7:10], "z": p[10:13]}

    c = pixel(1, 2)
    total, weights = torch.zeros(3, dtype=torch.float64), 0.0
    for row in range(-1, 4):
        for column in range(5):
            i = pixel(row, column)
            d = {name: ((c[name] - i[name]) ** 2).sum() for name in c}
            exponent = torch.stack(
                [torch.log(1 + d["y"]), torch.log(1 + d["z"]), d["albedo"], d["normal"], d["visibility"]]
            )
            w = tau if (row, column) == (1, 2) else torch.exp(-(exponent / (gamma**2 + 1e-4)).sum())
            g = i["y"] + beta[0] * (c["z"] - i["z"])
            g = g + beta[1] * (c["albedo"] - i["albedo"]) + beta[2] * (c["normal"] - i["normal"])
            total, weights = total + w * g, weights + w
    torch.testing.assert_close(got, total / weights)


@pytest.mark.parametrize("every", [2, 3, 4, 5])
def test_taken_taps_are_a_lattice_with_the_centre(every: int) -> None:
    """What a pixel's output depends on: one tap in ``every``, in all rows."""
    guides = make_guides(15, 15)
    planes = guides.planes.clone().requires_grad_()
    watched = replace(guides, planes=planes)
    raw = make_raw(guides, "eq10", (1, 1, 1))
    reference.cross_bilateral(watched, raw, torch.tensor([[7, 7]]), Window(15, every)).sum().backward()
    m = guides.margin
    taken = planes.grad[0, m : m + 15, m : m + 15] != 0
    assert taken[7, 7]
    assert taken.any(1).all()
    assert abs(int(taken.sum()) - 225 / every) < 4


@pytest.mark.parametrize("taps", [1, 7])
def test_reference_in_steps_is_the_same(taps: int) -> None:
    guides = make_guides(9, 8)
    corners = torch.tensor([[-1, 2]])
    raw = [make_raw(guides, "eq10", (1, 6, 5)).requires_grad_() for _ in range(2)]
    whole = exact(guides, raw[0], corners, Window(5))
    steps = reference.cross_bilateral(guides, raw[1], corners, Window(5), taps_per_step=taps)
    torch.testing.assert_close(steps, whole)
    whole.square().sum().backward()
    steps.square().sum().backward()
    torch.testing.assert_close(raw[1].grad, raw[0].grad)


def test_the_compiled_kernel_has_the_tables_terms() -> None:
    assert _cpu.terms() == [term.name for term in TERMS]


@sides((7,), interpreted=(3,))
@pytest.mark.parametrize("combination", ["eq10", "eq3"])
@every_set
def test_matches_reference(terms: Terms, combination: str, backend: str, side: int) -> None:
    guides = make_guides(23, 37, terms)
    corners = patches(backend, (0, 0), (-5, 10), (12, 20))
    raw = make_raw(guides, combination, (len(corners), 13, 19))
    compare(guides, raw, corners, Window(side, combination=combination), backend)


@sides((9,), interpreted=(5,))
@pytest.mark.parametrize("every", [2, 3, 4, 5])
def test_matches_reference_on_a_lattice(every: int, backend: str, side: int) -> None:
    guides = make_guides(20, 19)
    corners = patches(backend, (3, 0), (-2, 1))
    raw = make_raw(guides, "eq10", (len(corners), 16, 18))
    compare(guides, raw, corners, Window(side, every), backend)


@sides((1, 3, 19, 31), interpreted=(3,))
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (16, 1), (5, 7), (33, 15)])
def test_at_awkward_sizes(size: tuple[int, int], backend: str, side: int) -> None:
    """Images smaller than the window, one pixel, one more and less than a vector."""
    guides = make_guides(*size)
    compare(guides, make_raw(guides, "eq10", (1, *size)), ORIGIN, Window(side), backend)


@sides((5,), interpreted=(1,))
def test_any_strides(backend: str, side: int) -> None:
    guides = make_guides(20, 20)
    raw = make_raw(guides, "eq10", (2, 18, 20))
    corners = torch.tensor([[0, 0], [1, -1]])
    compare(guides, raw.contiguous(memory_format=torch.channels_last), corners, Window(side), backend)
    compare(guides, raw.transpose(2, 3).contiguous().transpose(2, 3), corners, Window(side), backend)


@sides((9,), interpreted=(3,))
@pytest.mark.parametrize("scale", [10.0, 100.0])
def test_saturated_heads(scale: float, backend: str, side: int) -> None:
    """β = ±1, bandwidths of 0 and of hundreds.

    Where every pixel of a scale's head is saturated, its gradient is only what rounding leaves of 1 − β²: as in torch.
    So the scales are measured by the largest gradient of all of them.
    """
    guides = make_guides(16, 20)
    compare(guides, make_raw(guides, "eq10", (1, 16, 20), scale), ORIGIN, Window(side), backend, "saturated")


@sides((9,), interpreted=(3,))
def test_extreme_radiance(backend: str, side: int) -> None:
    """A firefly as bright as guides can be: right in what sees it, and as right as ever in what does not."""
    guides = make_guides(16, 20)
    guides.planes[0, 25, 25] = LARGEST
    raw = make_raw(guides, "eq10", (1, 16, 20))
    compare(guides, raw, ORIGIN, Window(side), backend, "extreme")
    far = torch.tensor([[10, 10]])
    compare(guides, raw[:, :, 10:, 10:], far, Window(side), backend)


@sides((5,), interpreted=(3,))
@pytest.mark.parametrize("terms", [EVERY_SET[0], EVERY_SET[-1]], ids=names)
def test_fused_loss_matches_reference(terms: Terms, backend: str, side: int) -> None:
    guides = make_guides(21, 33, terms)
    other = make_guides(21, 33, terms, seed=5)
    weight = 1 / (other.denoised.mean(0) ** 2 + 0.01)
    corners = patches(backend, (0, 0), (-4, 18))
    raw, window = make_raw(guides, "eq10", (len(corners), 15, 21)), Window(side)
    expected_raw = raw.clone().requires_grad_()
    expected = reference.cross_bilateral_loss(guides, expected_raw, corners, other.radiance, weight, window)
    (3 * expected).backward()
    got_raw = leaf(backend, raw)
    target, weight = (values.float().to(got_raw.device) for values in (other.radiance, weight))
    if backend == "gpu":
        half = single(guides, DEVICE)
        got = gpu.cross_bilateral_loss(half, got_raw, corners, target, weight, window, tile=TILE)
    else:
        half = single(guides)
        got = cpu.cross_bilateral_loss(half, got_raw, corners, target, weight, window, threads=2, isa=backend)
    (3 * got).backward()
    assert_close("loss", got, expected, "cross-bilateral")
    assert_heads_close(got_raw.grad, expected_raw.grad, "cross-bilateral gradients")


def test_reference_loss_is_the_weighted_mean_square() -> None:
    """Half of Eq. 8 with the cut of the other half taken by hand."""
    guides, other = make_guides(12, 14), make_guides(12, 14, seed=5)
    raw = make_raw(guides, "eq10", (1, 6, 7))
    corners = torch.tensor([[3, -2]])
    weight = other.planes[3].abs()
    got = reference.cross_bilateral_loss(guides, raw, corners, other.radiance, weight, Window(3))
    at = (slice(23, 29), slice(18, 25))
    g = exact(guides, raw, corners, Window(3))[0]
    torch.testing.assert_close(got, (0.5 * weight[at] * (g - other.radiance[:, *at]) ** 2).mean())


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_stacked_crops_are_as_if_alone(backend: str) -> None:
    """The second of two crops below one another gives what it gives on its own, bit for bit."""
    crops = [single(make_guides(9, 11, seed=seed, margin=3), DEVICE) for seed in (0, 1)]
    raw = make_raw(crops[0], "eq10", (1, 4, 8)).float().to(DEVICE)
    corners = torch.tensor([[1, 2]])
    alone = cross_bilateral(crops[1], raw, corners, Window(3), backend=None if DEVICE == "cuda" else backend)
    stacked = Guides.stack(crops, len(crops))
    below = corners + torch.tensor([[stacked.pitch, 0]])
    got = cross_bilateral(stacked, raw, below, Window(3), backend=None if DEVICE == "cuda" else backend)
    assert torch.equal(got, alone)


def test_gpu_tiles_do_not_change_a_bit() -> None:
    """A pixel's value and gradient do not depend on the program that it falls to."""
    guides = single(make_guides(3, 33, ALWAYS), DEVICE)
    results = []
    for tile in ((4, 64), gpu.TILE):
        raw = leaf("gpu", make_raw(guides, "eq10", (1, 3, 33)))
        g = gpu.cross_bilateral(guides, raw, torch.tensor([[0, -1]]), Window(3), tile=tile)
        g.square().sum().backward()
        results.append((g.detach(), raw.grad))
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("backend", [b for b in BACKENDS if b != "gpu" or INTERPRETED])
def test_every_backend_gives_the_same(backend: str) -> None:
    """Through the function that callers use: what it chooses by itself is the compiled form."""
    guides = single(make_guides(4, 14))
    raw = make_raw(guides, "eq10", (1, 4, 14)).float()
    arguments = (guides, raw, ORIGIN)
    loss = (*arguments, guides.denoised, guides.planes[3].abs())
    for function, given in ((cross_bilateral, arguments), (cross_bilateral_loss, loss)):
        chosen, got = function(*given, Window(3)), function(*given, Window(3), backend=backend)
        torch.testing.assert_close(got, chosen, **near("cross-bilateral on others"))
        assert backend != "cpu" or torch.equal(got, chosen)


def test_threads_do_not_change_a_bit() -> None:
    guides = single(make_guides(40, 50))
    raw = make_raw(guides, "eq10", (2, 32, 40)).float()
    corners = torch.tensor([[0, 0], [-7, 11]])
    results = []
    for threads in (1, 2, 5):
        leaf = raw.clone().requires_grad_()
        weight = guides.planes[3]
        loss = cross_bilateral_loss(guides, leaf, corners, guides.denoised, weight, Window(7), threads=threads)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_patches_read_neighbours_from_the_whole_image() -> None:
    """A patch cut out of the middle gives what the whole image gives there."""
    guides = single(make_guides(30, 40))
    raw = make_raw(guides, "eq10", (1, 30, 40)).float()
    whole = cross_bilateral(guides, raw, ORIGIN, Window(19))
    part = cross_bilateral(guides, raw[:, :, 8:20, 3:36], torch.tensor([[8, 3]]), Window(19))
    torch.testing.assert_close(part, whole[:, :, 8:20, 3:36], **near("cross-bilateral in part"))


def test_bad_arguments_are_named() -> None:
    guides = single(make_guides(8, 8, margin=4))
    raw = make_raw(guides, "eq10", (1, 8, 8)).float()
    for side in (4, 33, -1):
        with pytest.raises(SettingsError, match="odd window"):
            Window(side)
    with pytest.raises(SettingsError, match="one tap in 1 or more"):
        Window(3, 0)
    with pytest.raises(SettingsError, match="combination"):
        Window(3, combination="eq4")
    with pytest.raises(FrameError, match=r"\(N, 15, h, w\)"):
        cross_bilateral(guides, raw[:, :14], ORIGIN, Window(3))
    with pytest.raises(FrameError, match="margin"):
        cross_bilateral(guides, raw, ORIGIN - 4, Window(3))
    with pytest.raises(FrameError, match="int64"):
        cross_bilateral(guides, raw, ORIGIN.float(), Window(3))
    with pytest.raises(FrameError, match=r"torch\.float32, but got torch\.float64"):
        cross_bilateral(guides, raw.double(), ORIGIN, Window(3))
