"""Sets of AOVs that sum to the picture, by the names of renderers and by their pixels."""

import numpy as np
import pytest
from helpers.exr_files import pixels, save, three

from selfcorrect import exr
from selfcorrect.errors import ChannelError
from selfcorrect.exr.aovs import Halves, plan, planes_of
from selfcorrect.exr.decompositions import candidates, closing_error, fitted, radiance, tolerance

SIZE = (24, 30)


def light(seed, dtype):
    return abs(pixels(seed, np.float32, SIZE)).astype(dtype)


def rendered(seed, color, terms, dtype=np.float32, **extra):
    """Channels of a picture and of AOVs that sum to it; a term is an AOV, or (lights, the colour they lack)."""
    channels, total, count = dict(extra), {}, 100 * seed
    for term in terms:
        lights, divisor = ([term], None) if isinstance(term, str) else term
        for letter in "RGB":
            shade = None
            if divisor:
                count += 1
                shade = channels.setdefault(f"{divisor}.{letter}", (light(count, dtype) * 0.2).astype(dtype))
            for name in lights:
                count += 1
                values = light(count, dtype)
                channels[f"{name}.{letter}"] = values
                product = values.astype(np.float64) * (1.0 if shade is None else shade)
                total[letter] = total.get(letter, 0) + product
    prefix = f"{color}." if color else ""
    return channels | {f"{prefix}{letter}": total[letter].astype(dtype) for letter in "RGB"}


BLENDER_5 = [
    (["ViewLayer.Diffuse Direct", "ViewLayer.Diffuse Indirect"], "ViewLayer.Diffuse Color"),
    (["ViewLayer.Glossy Direct", "ViewLayer.Glossy Indirect"], "ViewLayer.Glossy Color"),
    (["ViewLayer.Transmission Direct", "ViewLayer.Transmission Indirect"], "ViewLayer.Transmission Color"),
    *(f"ViewLayer.{name}" for name in ("Volume Direct", "Volume Indirect", "Emission", "Environment")),
]
BLENDER_4 = [
    (["ViewLayer.DiffDir", "ViewLayer.DiffInd"], "ViewLayer.DiffCol"),
    (["ViewLayer.GlossDir", "ViewLayer.GlossInd"], "ViewLayer.GlossCol"),
    "ViewLayer.Emit",
    "ViewLayer.Env",
]
ARNOLD = [
    *("diffuse_direct", "diffuse_indirect", "specular_direct", "specular_indirect", "coat", "sss"),
    *("transmission_direct", "transmission_indirect", "volume", "emission", "background"),
]
SETS = {
    "Blender 5": ("ViewLayer.Combined", BLENDER_5, "Blender's light passes"),
    "Blender 4": ("ViewLayer.Combined", BLENDER_4, "Blender's light passes"),
    "Blender 5, its denoiser on": ("ViewLayer.Noisy Image", BLENDER_5, "Blender's light passes"),
    "Blender's groups": ("L.Combined", ["L.Combined_key", "L.Combined_fill"], "light groups Combined_…"),
    "Arnold": ("", ARNOLD, "Arnold's lobes"),
    "Arnold's lobes": ("", ["diffuse", "specular", "emission"], "Arnold's lobes"),
    "Arnold's groups": ("RGBA", ["RGBA_key", "RGBA_default", "RGBA_sky"], "light groups RGBA_…"),
    "direct and indirect": ("", ["direct", "indirect", "emission"], "direct and indirect light"),
    "RenderMan, a prefix": ("Ci", ["lpe_key", "lpe_rim", "lpe_env"], "AOVs lpe_…"),
    "RenderMan, any names": ("Ci", ["sun", "lamps", "rest"], "AOVs found by their sum"),
}


def both(tmp_path, color, terms, dtype=np.float32, b=True, **extra):
    halves = []
    for half, seed in (("a", 1), ("b", 2)):
        own = extra if half == "a" or b else {}
        halves.append(exr.read(save(tmp_path / f"{half}.exr", rendered(seed, color, terms, dtype, **own))))
    prefix = f"{color}." if color else ""
    return halves[0], halves[1], [f"{prefix}{letter}" for letter in "RGB"]


def names_above(color):
    return f"{color.rpartition('.')[0]}." if "." in color else ""


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("writer", SETS)
def test_every_renderers_set_is_found(tmp_path, writer, dtype):
    color, terms, name = SETS[writer]
    layer = names_above(color)
    other = {f"{layer}unlike.{letter}": light(7, dtype) for letter in "RGB"}
    a, b, names = both(tmp_path, color, terms, dtype, **other)
    found = plan(a, b, names, "auto")
    assert [group.name for group in found.groups] == [name]
    expected = {light.rpartition(".")[2] for t in terms for light in ([t] if isinstance(t, str) else t[0])}
    assert {aov.name for aov in found.groups[0].aovs} == expected == found.groups[0].wanted
    assert found.groups[0].sums
    assert found.written == 3 * len(expected)
    assert "sum to the picture within" in found.lines[0]


def test_two_sets_in_one_file_are_both_found(tmp_path):
    channels = [rendered(seed, "L.Combined", ["L.Emission", "L.Environment", "L.Volume Direct"]) for seed in (1, 2)]
    halves = []
    for number, own in enumerate(channels):
        for letter in "RGB":
            share = light(900 + number, np.float32) % 1
            own[f"L.Combined_key.{letter}"] = own[f"L.Combined.{letter}"] * share
            own[f"L.Combined_fill.{letter}"] = own[f"L.Combined.{letter}"] - own[f"L.Combined_key.{letter}"]
        halves.append(exr.read(save(tmp_path / f"{number}.exr", own)))
    found = plan(*halves, three("L.Combined"), "auto")
    assert [group.name for group in found.groups] == ["Blender's light passes", "light groups Combined_…"]


def test_a_transparent_film_leaves_the_world_out(tmp_path):
    """Blender writes the world into its pass also where the picture is transparent."""
    world = {f"ViewLayer.Environment.{letter}": light(8, np.float32) for letter in "RGB"}
    a, b, names = both(tmp_path, "ViewLayer.Combined", BLENDER_5[:-1], **world)
    found = plan(a, b, names, "auto")
    assert [group.name for group in found.groups] == ["Blender's light passes before a transparent film"]
    assert "Environment" not in found.groups[0].wanted
    assert "do not sum to the picture" in found.lines[0]
    dark = {name: np.zeros(SIZE, np.float32) for name in world}
    a, b, names = both(tmp_path, "ViewLayer.Combined", BLENDER_5[:-1], **dark)
    assert [group.name for group in plan(a, b, names, "auto").groups] == ["Blender's light passes"]


def test_a_set_that_does_not_sum_is_said(tmp_path):
    a, b, names = both(tmp_path, "", ["emission", "background", "diffuse"])
    assert plan(a, b, names, "auto").groups
    fewer = [
        exr.read(save(tmp_path / f"{h}2.exr", {n: f.pixels(n) for n in f.channel_names if not n.startswith("back")}))
        for h, f in (("a", a), ("b", b))
    ]
    found = plan(*fewer, names, "auto")
    assert found.groups == ()
    assert found.written == 0
    assert "do not sum to the picture: off by" in found.lines[0]
    assert "no set of them sums to the picture; none is corrected" in found.lines[-1]


def test_a_set_that_sums_in_one_half_only_is_none(tmp_path):
    a, b, names = both(tmp_path, "", ["emission", "background"])
    wrong = {n: b.pixels(n) * np.float32(1.01 if n == "emission.R" else 1) for n in b.channel_names}
    assert plan(a, exr.read(save(tmp_path / "w.exr", wrong)), names, "auto").groups == ()


def test_closing_is_held_to_rounding(tmp_path):
    a, _, names = both(tmp_path, "", ["emission", "background"])
    (one,) = candidates(a.channel_names, names)
    assert closing_error(a, names, one.aovs) < tolerance(a, names, one.aovs) == 1e-5
    off = {n: a.pixels(n) * np.float32(1 + 1e-4) if n == "emission.G" else a.pixels(n) for n in a.channel_names}
    file = exr.read(save(tmp_path / "off.exr", off))
    assert closing_error(file, names, one.aovs) > tolerance(file, names, one.aovs)


def test_a_fit_takes_no_share_of_an_aov(tmp_path):
    channels = rendered(1, "", ["sun", "lamps"])
    assert fitted(exr.read(save(tmp_path / "a.exr", channels)), ["R", "G", "B"]) is not None
    channels |= {f"sun.{letter}": channels[f"sun.{letter}"] * np.float32(0.5) for letter in "RGB"}
    assert fitted(exr.read(save(tmp_path / "b.exr", channels)), ["R", "G", "B"]) is None


def test_named_aovs_of_a_set_go_with_all_of_it(tmp_path):
    a, b, names = both(tmp_path, "", ["emission", "background", "diffuse"])
    found = plan(a, b, names, "diffuse, EMISSION")
    (group,) = found.groups
    assert group.wanted == {"diffuse", "emission"}
    assert len(group.aovs) == 3
    assert found.written == 6


def test_named_aovs_beside_no_set_leave_a_remainder(tmp_path):
    a, b, names = both(tmp_path, "", ["emission", "background", "diffuse"])
    fewer = [
        exr.read(save(tmp_path / f"{h}2.exr", {n: f.pixels(n) for n in f.channel_names if not n.startswith("back")}))
        for h, f in (("a", a), ("b", b))
    ]
    (group,) = plan(*fewer, names, "diffuse").groups
    assert group.sums
    assert group.remainder


def test_what_exceeds_the_picture_is_corrected_alone(tmp_path):
    bright = {f"unlit.{c}": light(5, np.float32) + 9 for c in "RGB"}
    a, b, names = both(tmp_path, "", ["emission", "background"], **bright)
    (group,) = plan(a, b, names, "unlit").groups
    assert not group.sums
    assert "each is corrected on its own" in plan(a, b, names, "unlit").lines[0]


def test_refusals(tmp_path):
    extra = {f"extra.{c}": light(5, np.float32) for c in "RGB"}
    a, b, names = both(tmp_path, "", ["emission", "background"], b=False, **extra)
    with pytest.raises(ChannelError, match=r"a\.exr: expected an AOV 'nothing' with R, G, B .*, but got .*emission"):
        plan(a, b, names, "nothing")
    with pytest.raises(ChannelError, match=r"b\.exr: expected the AOV 'extra' like .*a\.exr, but got none"):
        plan(a, b, names, "extra")
    with pytest.raises(ChannelError, match=r"expected an alpha channel beside the colour for --aovs alpha"):
        plan(a, b, names, "alpha")
    assert plan(a, b, names, "alpha", "A").alpha == "A"
    assert plan(a, b, names, "none").groups == ()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_light_is_divided_by_the_colour_that_is_written(tmp_path, dtype):
    """Then the product has the error of rounding one number: half a unit in the last place."""
    a, b, names = both(tmp_path, "L.Combined", [(["L.DiffDir", "L.DiffInd"], "L.DiffCol"), "L.Emit"], dtype)
    (group,) = plan(a, b, names, "auto").groups
    aov = group.aovs[0]
    assert aov.color == tuple(three("L.DiffCol"))
    wanted = sum(Halves(a, b, group.aovs)[aov.name]) / 2
    written = planes_of(a, b, aov, wanted)
    for index, letter in enumerate("RGB"):
        color = (a.pixels(f"L.DiffCol.{letter}").astype(np.float64) + b.pixels(f"L.DiffCol.{letter}")) / 2
        product = written[f"L.DiffDir.{letter}"].astype(np.float64) * color.astype(dtype)
        assert np.all(abs(product - wanted[..., index]) <= np.finfo(dtype).eps * wanted[..., index])
    assert radiance(a, aov).shape == (*SIZE, 3)


def test_files_give_up_what_is_read_once(tmp_path):
    """The pixels, not what else is known of the channel; colours and what others read stay."""
    a, b, names = both(tmp_path, "L.Combined", [(["L.DiffDir", "L.DiffInd"], "L.DiffCol"), "L.Emit"], np.float16)
    (group,) = plan(a, b, names, "auto").groups
    diffuse, emission = group.aovs[0], next(aov for aov in group.aovs if aov.channels == tuple(three("L.Emit")))
    before = Halves(a, b, group.aovs)[diffuse.name], Halves(a, b, group.aovs)[emission.name]
    frugal = Halves(a, b, group.aovs, once=frozenset(emission.channels))
    for aov, pair in zip((diffuse, emission), before, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(frugal[aov.name], pair, strict=True))
    for file in (a, b):
        assert {file.pixels(name).size for name in emission.channels} == {0}
        assert {file.pixels(name).shape for name in (*diffuse.channels, *diffuse.color)} == {SIZE}
    assert set(planes_of(a, b, emission, before[1][0])) == set(emission.channels)
