"""Every number of the published method (Back et al. 2022), pinned."""

import math

import numpy as np
import pytest
import torch
from helpers.tolerances import LOSS_BY_HAND, RATE, near

from selfcorrect import Frame, Settings, correct
from selfcorrect.buffers import TERMS
from selfcorrect.kernel.cross_bilateral import Window, heads_count, reference
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.loss import dual_buffer_loss, learning_rate, witnesses
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import grid

PAPER = Settings.preset("paper")


def full_guides(height: int = 12, width: int = 10, seed: int = 0) -> Guides:
    generator = torch.Generator().manual_seed(seed)

    def buffer(channels: int) -> torch.Tensor:
        return torch.rand(height, width, channels, generator=generator)

    return Guides.of_half({term.name: buffer(term.channels) for term in TERMS}, margin=9)


def make_network(guides: Guides, settings: Settings = PAPER) -> Network:
    return Network.for_guides(guides, settings, torch.Generator().manual_seed(0))


def test_settings() -> None:
    assert (PAPER.window, PAPER.filters, PAPER.layers) == (19, 16, 9)
    assert (PAPER.patch, PAPER.stride, PAPER.batch, PAPER.epochs) == (128, 64, 16, 20)
    assert (PAPER.learning_rate, PAPER.adam_epsilon, PAPER.loss_epsilon) == (0.01, 1e-7, 0.01)
    assert PAPER.combination == "eq10"


def test_network_has_20303_parameters() -> None:
    guides = full_guides()
    network = make_network(guides)
    assert guides.planes.shape[0] == 13
    assert heads_count(guides, "eq10") == 15
    assert sum(p.numel() for p in network.parameters()) == 20303
    assert [tuple(c.weight.shape) for c in network.convolutions] == [
        (16, 13, 3, 3),
        *[(16, 16, 3, 3)] * 7,
        (15, 16, 3, 3),
    ]


def test_glorot_uniform_weights_and_zero_biases() -> None:
    for convolution in make_network(full_guides()).convolutions:
        fan = 9 * sum(convolution.weight.shape[:2])
        bound = math.sqrt(6 / fan)
        weight = convolution.weight.detach()
        assert weight.abs().max() <= bound
        assert weight.std() == pytest.approx(bound / math.sqrt(3), rel=0.1)
        assert convolution.bias.detach().eq(0).all()


def test_relu_between_and_zero_padding() -> None:
    guides = full_guides()
    network = make_network(guides)
    x = guides.planes[None, :, 9:21, 9:19]
    expected = x
    for i, convolution in enumerate(network.convolutions):
        padded = torch.nn.functional.pad(expected, (1, 1, 1, 1))
        expected = torch.nn.functional.conv2d(padded, convolution.weight, convolution.bias)
        expected = expected.relu() if i < 8 else expected
    torch.testing.assert_close(network(x), expected, **near("network by hand"))


def test_heads_are_nine_scales_five_bandwidths_one_centre_weight() -> None:
    guides = full_guides()
    raw = torch.randn(1, 15, 4, 4)
    heads = reference.activate(raw, guides, "eq10")
    assert [term.name for term in heads.beta] == ["denoised", "albedo", "normal"]
    for i, beta in enumerate(heads.beta.values()):
        torch.testing.assert_close(beta, raw[:, 3 * i : 3 * i + 3].tanh())
    assert [term.name for term in heads.gamma] == ["color", "denoised", "albedo", "normal", "visibility"]
    for i, gamma in enumerate(heads.gamma.values()):
        torch.testing.assert_close(gamma, torch.log1p(raw[:, 9 + i : 10 + i].exp()))
    torch.testing.assert_close(heads.tau, torch.log1p(raw[:, 14:15].exp()))
    assert reference.EPSILON == 1e-4


def test_inputs_are_radiance_albedo_visibility_normal_denoised() -> None:
    constants = {"color": 1.0, "albedo": 2.0, "visibility": 3.0, "normal": 4.0, "denoised": 5.0}
    images = {k: torch.full((2, 2, 1 if k == "visibility" else 3), v) for k, v in constants.items()}
    planes = Guides.of_half(images, margin=1).planes
    assert planes[:, 0, 0].tolist() == [1, 1, 1, 2, 2, 2, 3, 4, 4, 4, 5, 5, 5]


@pytest.mark.parametrize(("buffers", "inputs", "heads"), [((), 6, 6), (("albedo",), 9, 10), (("normal",), 9, 10)])
def test_absent_buffers_are_not_modelled(buffers: tuple[str, ...], inputs: int, heads: int) -> None:
    image = torch.rand(4, 4, 3)
    guides = Guides.of_half(dict.fromkeys(("color", "denoised", *buffers), image), margin=1)
    assert guides.planes.shape[0] == inputs
    assert heads_count(guides, "eq10") == heads


def test_eq3_fixes_the_scales() -> None:
    """Table 1's other combination: z_c + Σ w_i (y_i − z_i) / Σ w_i; only bandwidths and τ are learned."""
    guides = full_guides()
    assert heads_count(guides, "eq3") == 6
    raw = torch.randn(1, 6, 12, 10)
    corners = torch.zeros(1, 2, dtype=torch.int64)
    eq3 = reference.cross_bilateral(guides, raw, corners, Window(3, combination="eq3"))
    saturated = torch.cat([torch.full((1, 3, 12, 10), 50.0), torch.zeros(1, 6, 12, 10), raw], 1)
    eq10 = reference.cross_bilateral(guides, saturated, corners, Window(3))
    torch.testing.assert_close(eq3, eq10)


def test_learning_rate_is_a_hundredth_of_the_halves_deviation() -> None:
    guides = (full_guides(seed=1), full_guides(seed=2))
    a, b = (half.planes[:3, 9:-9, 9:-25] for half in guides)
    assert a.shape == (3, 12, 10)
    expected = 0.01 * math.sqrt(float((a - b).square().mean()) / 4)
    assert learning_rate(guides, PAPER) == pytest.approx(expected, rel=RATE)


def test_loss_is_eq8() -> None:
    guides = (full_guides(seed=1), full_guides(seed=2))
    corners = torch.tensor([[0, 0], [2, 1]])
    raw = torch.randn(4, 15, 8, 8)
    loss = float(dual_buffer_loss(raw, corners, guides, witnesses(guides, PAPER), PAPER))
    terms = []
    for g_from, other, heads in ((guides[0], guides[1], raw[:2]), (guides[1], guides[0], raw[2:])):
        g = reference.cross_bilateral(g_from, heads, corners, Window(19))
        cut = other.patches(corners, (8, 8))
        y, z = cut[:, :3], cut[:, -3:]
        terms.append((g - y) ** 2 / (z.mean(1, keepdim=True) ** 2 + 0.01))
    assert loss == pytest.approx(float((0.5 * (terms[0] + terms[1])).mean()), rel=LOSS_BY_HAND)


def test_first_bandwidths_and_names_of_the_buffers() -> None:
    """What saved states and the residual initialisation rely on."""
    settings = Settings.preset("paper", initialisation="residual")
    network = make_network(full_guides(), settings)
    assert network.traits.buffers == "color+albedo+visibility+normal+denoised"
    beta_z, beta, gamma, tau = network.convolutions[-1].bias.detach().split([3, 6, 5, 1])
    torch.testing.assert_close(beta_z.tanh(), torch.full((3,), 0.9))
    assert beta.eq(0).all()
    torch.testing.assert_close(torch.nn.functional.softplus(gamma), torch.tensor([3.0, 1.0, 0.2, 0.4, 0.2]))
    torch.testing.assert_close(torch.nn.functional.softplus(tau), torch.tensor([0.05]))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (64, 65), (270, 480), (360, 352), (1024, 1024)])
def test_patch_grid(height: int, width: int) -> None:
    corners = grid(height, width, patch=128, stride=64)
    rows, columns = corners[:, 0].unique(), corners[:, 1].unique()
    assert len(corners) == math.ceil(height / 64) * math.ceil(width / 64)
    for starts, size in ((rows, height), (columns, width)):
        assert (starts.diff() == 64).all()
        before, after = -int(starts[0]), int(starts[-1]) + 128 - size
        assert before >= 0
        assert before - after in (0, 1), "centred on the image"


def test_steps_and_shuffling() -> None:
    """20 epochs of ⌈patches/16⌉ steps; every patch once an epoch; the last batch smaller."""
    generator = np.random.default_rng(0)
    color, denoised = (tuple(generator.random((70, 150, 3), dtype=np.float32) for _ in "ab") for _ in "yz")
    result = correct(
        Frame(color=color, denoised=denoised),
        Settings.preset("paper", patch=32, stride=16, window=3, epochs=3, filters=2, layers=2),
    )
    patches = math.ceil(70 / 16) * math.ceil(150 / 16)
    assert patches % 16
    assert len(result.losses) == 3 * math.ceil(patches / 16)


def test_result_is_the_clipped_mean_of_both_outputs() -> None:
    """max(0, ½(g^a + g^b)), from the network on the whole image."""
    generator = np.random.default_rng(1)
    color = tuple(generator.random((20, 24, 3), dtype=np.float32) for _ in "ab")
    frame = Frame(color=color, denoised=tuple(x * 0.1 for x in color))
    result = correct(frame, Settings.preset("paper", epochs=1))
    outputs = []
    for half in frame.halves:
        guides = Guides.of_half(half._asdict(), margin=9)
        origin = torch.zeros(1, 2, dtype=torch.int64)
        with torch.no_grad():
            raw = result.network(guides.patches(origin, (20, 24)))
        outputs.append(reference.cross_bilateral(guides, raw, origin, Window(19))[0].permute(1, 2, 0))
    expected = ((outputs[0] + outputs[1]) / 2).clamp(min=0)
    torch.testing.assert_close(torch.from_numpy(result.image), expected, **near("paper by hand"))
