"""The channels beside the colour: which are the mean of both halves, and which stay as half a has them."""

import numpy as np
import pytest
from helpers.exr_files import arrays, pixels, same_bits, save, three

from selfcorrect import exr, files
from selfcorrect.errors import FileError
from selfcorrect.exr.passes import linear_channels, means, picture

LINEAR = {
    "Blender 5": [
        *three("ViewLayer.Combined", "RGBA"),
        *three("ViewLayer.Diffuse Direct"),
        *three("ViewLayer.Diffuse Color"),
        *three("ViewLayer.Volume Indirect"),
        *three("ViewLayer.Combined_key"),
        *three("ViewLayer.Shadow Catcher"),
        *three("ViewLayer.Denoising Albedo"),
        "ViewLayer.Mist.Z",
    ],
    "Arnold": [*"RGBA", *three("diffuse_direct"), *three("RGBA_key"), *three("emission"), *three("opacity")],
    "RenderMan": [*three("Ci"), "a.A", *three("lpe_key"), *three("directSpecular"), *three("albedo")],
    "Mitsuba 3": [*"RGB", *three("albedo"), *three("image", "RGBA")],
}
KEPT = {
    "Blender 5": [
        *three("ViewLayer.CryptoObject00", "rgba"),
        "ViewLayer.Depth.Z",
        *three("ViewLayer.Normal", "XYZ"),
        *three("ViewLayer.Denoising Normal", "XYZ"),
        *three("ViewLayer.Position", "XYZ"),
        *three("ViewLayer.Vector", "XYZW"),
        *three("ViewLayer.UV", "XYZ"),
        "ViewLayer.Object Index.X",
        "ViewLayer.Debug Sample Count.X",
        "ViewLayer.someone's own.V",
    ],
    "Arnold": ["Z", *three("N", "XYZ"), *three("N_noice"), *three("crypto_asset00"), *three("P"), "AA_inv_density.R"],
    "RenderMan": ["z", *three("albedo_mse"), *three("normal"), *three("__Pworld"), "id", "sampleCount", "st.R"],
    "Mitsuba 3": [*three("nn", "XYZ"), "dd.T", "shape_index.I", *three("uv", "UV")],
}


@pytest.mark.parametrize("writer", LINEAR)
def test_what_each_renderer_writes(tmp_path, writer):
    names = LINEAR[writer] + KEPT[writer]
    file = exr.read(save(tmp_path / "a.exr", arrays(names)))
    assert sorted(linear_channels(file)) == sorted(LINEAR[writer])


def test_whole_numbers_and_what_the_file_calls_cryptomatte_are_kept(tmp_path):
    header = {"cryptomatte/a1b2c3/name": "ViewLayer.Names", "cryptomatte/a1b2c3/hash": "MurmurHash3_32"}
    channels = arrays([*"RGB", *three("ViewLayer.Names00")]) | {n: pixels(5, np.uint32) for n in three("ids")}
    assert sorted(linear_channels(exr.read(save(tmp_path / "a.exr", channels, **header)))) == ["B", "G", "R"]


def both(tmp_path, names, dtype=np.float16, **header):
    halves = (
        save(tmp_path / "a.exr", arrays(names, dtype), **header),
        save(tmp_path / "b.exr", arrays(names, dtype, 50), **header),
    )
    return exr.read(halves[0]), exr.read(halves[1])


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_the_mean_of_both_halves(tmp_path, dtype):
    a, b = both(tmp_path, [*"RGBAZ", *three("emission")], dtype)
    found, others = means(a, b, but="RGB")
    assert sorted(found) == sorted(["A", *three("emission")])
    assert (others.mean, others.kept, others.lacking) == (4, 1, ())
    for name, values in found.items():
        expected = (a.pixels(name).astype(np.float64) + b.pixels(name).astype(np.float64)) / 2
        assert same_bits(values, expected.astype(dtype))


def test_light_that_was_divided_by_its_colour_is_weighed_by_it(tmp_path):
    """The product of light and colour is linear in the samples, and so the mean of products is what is kept."""
    names = [*three("L.Combined"), *three("L.Diffuse Direct"), *three("L.Diffuse Color")]
    a, b = ({n: abs(array) for n, array in arrays(names, np.float32, start).items()} for start in (0, 50))
    a["L.Diffuse Color.R"][0, :3] = [0, 0, 0.5]
    b["L.Diffuse Color.R"][0, :3] = [0, 0.5, 0]
    halves = exr.read(save(tmp_path / "a.exr", a)), exr.read(save(tmp_path / "b.exr", b))
    found, _ = means(*halves, but=three("L.Combined"))
    for letter in "RGB":
        light, color = f"L.Diffuse Direct.{letter}", f"L.Diffuse Color.{letter}"
        product = found[light].astype(np.float64) * found[color]
        expected = (a[light].astype(np.float64) * a[color] + b[light].astype(np.float64) * b[color]) / 2
        assert np.allclose(product, expected, rtol=1e-6, atol=0)
    assert found["L.Diffuse Direct.R"][0, 1] == b["L.Diffuse Direct.R"][0, 1]
    assert found["L.Diffuse Direct.R"][0, 2] == a["L.Diffuse Direct.R"][0, 2]


def test_a_half_that_is_not_finite_leaves_the_other(tmp_path):
    a, b = arrays([*"RGBA"]), arrays([*"RGBA"], start=50)
    a["A"][0, :3] = np.nan, 1, np.inf
    b["A"][0, :3] = 1, np.inf, np.nan
    found, _ = means(exr.read(save(tmp_path / "a.exr", a)), exr.read(save(tmp_path / "b.exr", b)), but="RGB")
    assert found["A"][0, :3].tolist() == [1, 1, np.inf]


def test_what_half_b_lacks_is_as_in_half_a(tmp_path):
    a = exr.read(save(tmp_path / "a.exr", arrays([*"RGBA", *three("emission")])))
    b = exr.read(save(tmp_path / "b.exr", arrays([*"RGBA"], start=50)))
    found, others = means(a, b, but="RGB")
    assert list(found) == ["A"]
    assert sorted(others.lacking) == sorted(three("emission"))
    assert "in half a only" in others.lines()[1]


NOISY = [*three("ViewLayer.Combined", "RGBA"), *three("ViewLayer.Noisy Image"), *three("ViewLayer.Emission")]


def parts_of(names, start):
    """One part per pass, as Blender 5 writes them."""
    channels = {n: abs(array) for n, array in arrays(names, np.float32, start).items()}
    passes = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return [(p, {n: a for n, a in channels.items() if n.rpartition(".")[0] == p}, {}) for p in passes]


@pytest.mark.parametrize("pass_through", [False, True])
def test_the_picture_that_blender_has_denoised_gets_the_correction(tmp_path, pass_through):
    paths = [str(save(tmp_path / f"{h}.exr", *parts_of(NOISY, s))) for h, s in (("a", 0), ("b", 50))]
    loaded = files.load(files.Sources(*paths))
    assert loaded.origin.taken["color"] == three("ViewLayer.Noisy Image")
    image = np.full((9, 14, 3), 0.25, np.float32)
    saved = files.save(str(tmp_path / "o.exr"), loaded.origin, {"color": image}, {}, pass_through=pass_through)
    a, b, out = (exr.read(path) for path in (*paths, tmp_path / "o.exr"))
    assert all((out.pixels(name) == 0.25).all() for name in three("ViewLayer.Combined"))
    for name in (*three("ViewLayer.Noisy Image"), *three("ViewLayer.Emission"), "ViewLayer.Combined.A"):
        mean = ((a.pixels(name).astype(np.float64) + b.pixels(name)) / 2).astype(np.float32)
        assert same_bits(out.pixels(name), a.pixels(name) if pass_through else mean)
    assert (saved.others.mean, saved.others.kept) == ((0, 7) if pass_through else (7, 0))
    shown, names = exr.load_picture(tmp_path / "o.exr")
    assert names == three("ViewLayer.Combined")
    assert (shown == 0.25).all()
    assert exr.load_picture(f"{tmp_path / 'o.exr'}::ViewLayer.Noisy Image")[1] == three("ViewLayer.Noisy Image")


def test_a_picture_of_another_layer_is_left(tmp_path):
    names = [*three("Other.Combined"), *three("ViewLayer.Noisy Image")]
    assert picture(names, three("ViewLayer.Noisy Image")) == tuple(three("ViewLayer.Noisy Image"))


def test_a_half_that_changed_meanwhile_is_refused(tmp_path):
    paths = [str(save(tmp_path / f"{h}.exr", arrays(["R", "G", "B"], start=s))) for h, s in (("a", 0), ("b", 50))]
    loaded = files.load(files.Sources(*paths))
    save(paths[1], arrays(["R", "G", "B", "A"], start=7))
    with pytest.raises(FileError, match=r"b\.exr: expected the file that was read"):
        files.save(str(tmp_path / "o.exr"), loaded.origin, {"color": np.zeros((9, 14, 3))}, {})
