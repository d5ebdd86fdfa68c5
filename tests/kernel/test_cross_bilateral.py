"""The kernel: gradcheck of the reference, and the compiled variants against it, values and every gradient."""

from itertools import product

import pytest
import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.exposure import LARGEST
from selfcorrect.kernel.cross_bilateral import cpu, cross_bilateral, cross_bilateral_loss, heads_count, reference
from selfcorrect.kernel.guides import Guides, mirror

# Largest difference to the float64 reference, over the largest value: (values, gradients).
# Worst measured over this file's cases: 1.7e-6 and 6.7e-6.
TOLERANCE = {torch.float32: (1e-5, 3e-5)}

BUFFERS = list(product((False, True), repeat=3))
VARIANTS = cpu.instruction_sets()


def make_guides(
    height: int,
    width: int,
    buffers: tuple[bool, bool, bool] = (True, True, True),
    *,
    margin: int = 20,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> Guides:
    generator = torch.Generator().manual_seed(seed)

    def buffer(channels: int, low: float = 0.0) -> Tensor:
        return low + (1 - low) * torch.rand(height, width, channels, generator=generator, dtype=dtype)

    albedo, normal, visibility = buffers
    return Guides.of_half(
        4 * buffer(3) ** 3,
        2 * buffer(3),
        margin=margin,
        albedo=buffer(3) if albedo else None,
        normal=buffer(3, -1.0) if normal else None,
        visibility=buffer(1) if visibility else None,
    )


def make_raw(guides: Guides, combination: str, shape: tuple[int, int, int], scale: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    n, h, w = shape
    return scale * torch.randn(n, heads_count(guides, combination), h, w, generator=generator, dtype=torch.float64)


def single(guides: Guides) -> Guides:
    values = vars(guides) | {"planes": guides.planes.float()}
    return Guides(**values)


def assert_close(name: str, got: Tensor, expected: Tensor, tolerance: float) -> None:
    assert got.isfinite().all(), name
    expected = expected.detach()
    worst = float((got.detach().double() - expected).abs().max() / expected.abs().max().clamp(min=1e-9))
    assert worst < tolerance, f"{name}: off by {worst:.2e} of the maximum"


def compare(
    guides: Guides, raw: Tensor, corners: Tensor, window: int, combination: str, isa: str, every: int = 1
) -> None:
    """Values and the gradient of every head, under a random upstream gradient."""
    values, gradients = TOLERANCE[torch.float32]
    expected_raw = raw.clone().requires_grad_()
    expected = reference.cross_bilateral(
        guides, expected_raw, corners, window=window, every=every, combination=combination
    )
    upstream = torch.randn(expected.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (expected * upstream).sum().backward()

    got_raw = raw.float().requires_grad_()
    got = cpu.cross_bilateral(
        single(guides), got_raw, corners, window=window, every=every, combination=combination, threads=2, isa=isa
    )
    (got * upstream.float()).sum().backward()
    assert_close("g", got, expected, values)
    for head in range(raw.shape[1]):
        assert_close(f"head {head}", got_raw.grad[:, head], expected_raw.grad[:, head], gradients)


@pytest.mark.parametrize("combination", ["eq10", "eq3"])
@pytest.mark.parametrize("buffers", BUFFERS)
def test_reference_gradcheck(buffers: tuple[bool, bool, bool], combination: str) -> None:
    guides = make_guides(5, 6, buffers)
    raw = make_raw(guides, combination, (2, 3, 3)).requires_grad_()
    corners = torch.tensor([[0, 0], [3, -2]])

    def function(raw: Tensor) -> Tensor:
        return reference.cross_bilateral(guides, raw, corners, window=3, combination=combination)

    assert torch.autograd.gradcheck(function, raw)


def test_reference_by_hand() -> None:
    """Eqs. 10 and 11 with plain loops, at one pixel."""
    guides = make_guides(7, 7)
    raw = make_raw(guides, "eq10", (1, 7, 7))
    got = reference.cross_bilateral(guides, raw, torch.zeros(1, 2, dtype=torch.int64), window=5)[0, :, 1, 2]
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
    watched = Guides(**(vars(guides) | {"planes": planes}))
    raw = make_raw(guides, "eq10", (1, 1, 1))
    corners = torch.tensor([[7, 7]])
    reference.cross_bilateral(watched, raw, corners, window=15, every=every).sum().backward()
    m = guides.margin
    taken = planes.grad[0, m : m + 15, m : m + 15] != 0
    assert taken[7, 7]
    assert taken.any(1).all()
    assert abs(int(taken.sum()) - 225 / every) < 4


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("every", [2, 3, 4, 5])
def test_cpu_matches_reference_on_a_lattice(every: int, isa: str) -> None:
    guides = make_guides(20, 19)
    raw = make_raw(guides, "eq10", (2, 17, 18))
    compare(guides, raw, torch.tensor([[-2, 1], [3, 0]]), 9, "eq10", isa, every)


@pytest.mark.parametrize("taps", [1, 7])
def test_reference_in_steps_is_the_same(taps: int) -> None:
    guides = make_guides(9, 8)
    corners = torch.tensor([[-1, 2]])
    raw = [make_raw(guides, "eq10", (1, 6, 5)).requires_grad_() for _ in range(2)]
    whole = reference.cross_bilateral(guides, raw[0], corners, window=5)
    steps = reference.cross_bilateral(guides, raw[1], corners, window=5, taps_per_step=taps)
    torch.testing.assert_close(steps, whole)
    whole.square().sum().backward()
    steps.square().sum().backward()
    torch.testing.assert_close(raw[1].grad, raw[0].grad)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("combination", ["eq10", "eq3"])
@pytest.mark.parametrize("buffers", BUFFERS)
def test_cpu_matches_reference(buffers: tuple[bool, bool, bool], combination: str, isa: str) -> None:
    guides = make_guides(23, 37, buffers)
    corners = torch.tensor([[0, 0], [-5, 10], [12, 20]])
    compare(guides, make_raw(guides, combination, (3, 13, 19)), corners, 7, combination, isa)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("window", [1, 3, 19, 31])
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (16, 1), (5, 7), (33, 15)])
def test_cpu_at_awkward_sizes(size: tuple[int, int], window: int, isa: str) -> None:
    """Images smaller than the window, one pixel, one more and less than a vector."""
    guides = make_guides(*size)
    compare(guides, make_raw(guides, "eq10", (1, *size)), torch.zeros(1, 2, dtype=torch.int64), window, "eq10", isa)


@pytest.mark.parametrize("isa", VARIANTS)
def test_cpu_takes_any_strides(isa: str) -> None:
    guides = make_guides(20, 20)
    raw = make_raw(guides, "eq10", (2, 18, 20))
    corners = torch.tensor([[0, 0], [1, -1]])
    compare(guides, raw.contiguous(memory_format=torch.channels_last), corners, 5, "eq10", isa)
    compare(guides, raw.transpose(2, 3).contiguous().transpose(2, 3), corners, 5, "eq10", isa)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("scale", [10.0, 100.0])
def test_cpu_with_saturated_heads(scale: float, isa: str) -> None:
    """β = ±1, bandwidths of 0 and of hundreds: finite, and the value still right."""
    guides = make_guides(20, 20)
    raw = make_raw(guides, "eq10", (1, 20, 20), scale)
    corners = torch.zeros(1, 2, dtype=torch.int64)
    expected = reference.cross_bilateral(guides, raw, corners, window=9)
    got_raw = raw.float().requires_grad_()
    got = cpu.cross_bilateral(
        single(guides), got_raw, corners, window=9, every=1, combination="eq10", threads=1, isa=isa
    )
    got.sum().backward()
    assert_close("g", got, expected, 1e-4)
    assert got_raw.grad.isfinite().all()


@pytest.mark.parametrize("isa", VARIANTS)
def test_cpu_with_extreme_radiance(isa: str) -> None:
    guides = make_guides(20, 20)
    guides.planes[0, 25, 25] = LARGEST
    raw = make_raw(guides, "eq10", (1, 20, 20))
    corners = torch.zeros(1, 2, dtype=torch.int64)
    expected = reference.cross_bilateral(guides, raw, corners, window=9)
    got_raw = raw.float().requires_grad_()
    got = cpu.cross_bilateral(
        single(guides), got_raw, corners, window=9, every=1, combination="eq10", threads=1, isa=isa
    )
    assert_close("g", got, expected, 1e-4)
    got.sum().backward()
    assert got_raw.grad.isfinite().all()


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("buffers", [(True, True, True), (False, True, False)])
def test_fused_loss_matches_reference(buffers: tuple[bool, bool, bool], isa: str) -> None:
    guides = make_guides(21, 33, buffers)
    other = make_guides(21, 33, buffers, seed=5)
    weight = 1 / (other.denoised.mean(0) ** 2 + 0.01)
    corners = torch.tensor([[0, 0], [-4, 18]])
    raw = make_raw(guides, "eq10", (2, 17, 21))
    expected_raw = raw.clone().requires_grad_()
    expected = cross_bilateral_loss(guides, expected_raw, corners, other.radiance, weight, window=5)
    (3 * expected).backward()
    got_raw = raw.float().requires_grad_()
    got = cpu.cross_bilateral_loss(
        single(guides),
        got_raw,
        corners,
        other.radiance.float(),
        weight.float(),
        window=5,
        every=1,
        combination="eq10",
        threads=2,
        isa=isa,
    )
    (3 * got).backward()
    values, gradients = TOLERANCE[torch.float32]
    assert_close("loss", got, expected, values)
    for head in range(raw.shape[1]):
        assert_close(f"head {head}", got_raw.grad[:, head], expected_raw.grad[:, head], gradients)


def test_threads_do_not_change_a_bit() -> None:
    guides = single(make_guides(40, 50))
    raw = make_raw(guides, "eq10", (2, 32, 40)).float()
    corners = torch.tensor([[0, 0], [-7, 11]])
    results = []
    for threads in (1, 2, 5):
        leaf = raw.clone().requires_grad_()
        loss = cross_bilateral_loss(guides, leaf, corners, guides.denoised, guides.planes[3], window=7, threads=threads)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_mirror_is_numpy_symmetric() -> None:
    import numpy as np

    for size in (1, 2, 5):
        expected = np.pad(np.arange(size), 13, mode="symmetric")
        assert mirror(-13, size + 13, size).tolist() == expected.tolist()


def test_patches_read_neighbours_from_the_whole_image() -> None:
    """A patch cut out of the middle gives what the whole image gives there."""
    guides = single(make_guides(30, 40))
    raw = make_raw(guides, "eq10", (1, 30, 40)).float()
    whole = cross_bilateral(guides, raw, torch.zeros(1, 2, dtype=torch.int64), window=19)
    part = cross_bilateral(guides, raw[:, :, 8:20, 3:36], torch.tensor([[8, 3]]), window=19)
    torch.testing.assert_close(part, whole[:, :, 8:20, 3:36], rtol=1e-6, atol=1e-6)


def test_bad_arguments_are_named() -> None:
    guides = single(make_guides(8, 8, margin=4))
    raw = make_raw(guides, "eq10", (1, 8, 8)).float()
    corners = torch.zeros(1, 2, dtype=torch.int64)
    with pytest.raises(SettingsError, match="odd window"):
        cross_bilateral(guides, raw, corners, window=4)
    with pytest.raises(SettingsError, match="odd window"):
        cross_bilateral(guides, raw, corners, window=33)
    with pytest.raises(SettingsError, match="combination"):
        cross_bilateral(guides, raw, corners, window=3, combination="eq4")
    with pytest.raises(FrameError, match=r"\(N, 15, h, w\)"):
        cross_bilateral(guides, raw[:, :14], corners, window=3)
    with pytest.raises(FrameError, match="margin"):
        cross_bilateral(guides, raw, corners - 4, window=3)
    with pytest.raises(FrameError, match="int64"):
        cross_bilateral(guides, raw, corners.float(), window=3)
