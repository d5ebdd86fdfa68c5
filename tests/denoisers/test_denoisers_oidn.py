"""What is particular to OIDN: its modes, prefiltered features, threads and memory."""

import pytest
import torch
from helpers.images import image
from helpers.tolerances import near
from mitsuba_oidn import Device, DeviceType

import denoisers
from denoisers import Denoise
from denoisers.mirror import mirrored
from denoisers.oidn import MODES, Oidn, PrefilteringOidn
from selfcorrect import Frame
from selfcorrect.errors import DenoiserError
from selfcorrect.stages.deep_combiner_4 import SubImages


class TestOidn:
    def test_less_scratch_gives_the_same_bits(self) -> None:
        color, albedo, normal = image(600, 700), image(600, 700, 1) * 1.4 - 0.2, image(600, 700, 2) * 2.6 - 1.3
        whole = Oidn(1).denoise(color, albedo.clamp(0, 1), normal.clamp(-1, 1))
        assert torch.equal(Oidn(1, scratch=1).denoise(color, albedo, normal), whole), "OIDN clamps by itself"

    @pytest.mark.parametrize("spec", ["oidn:fast", "oidn:none"])
    def test_half_floats_are_read_where_they_are(self, spec: str) -> None:
        color, albedo, normal = image(64, 48), image(64, 48, 1).half(), image(64, 48, 2).half()
        denoise = denoisers.create(spec, threads=1)
        assert torch.equal(denoise(color, albedo, normal), denoise(color, albedo.float(), normal.float()))

    def test_it_denoises(self) -> None:
        clean = 1 + image(1, 1).expand(64, 64, 3)
        noisy = clean * -torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(1)).log()
        result = denoisers.create("oidn")(noisy)
        assert (result - clean).square().mean() < 0.01 * (noisy - clean).square().mean()

    def test_threads_are_honoured_and_hardly_matter(self) -> None:
        color, albedo, normal = image(272, 480) * 20, image(272, 480, 1), image(272, 480, 2)
        first, second, third = (Oidn(threads).denoise(color, albedo, normal) for threads in (1, 2, 2))
        assert torch.equal(second, third)
        torch.testing.assert_close(first, second, **near("OIDN and threads"))  # 5.4e-6 measured
        assert Oidn(2).device.num_threads == 2

    @pytest.mark.parametrize("spec", MODES)
    def test_features_out_of_range_are_clamped(self, spec: str) -> None:
        color, albedo, normal = image(40, 40) * 5, image(40, 40, 1) * 3 - 1, image(40, 40, 2) * 6 - 3
        denoise = denoisers.create(spec)
        expected = denoise(color, albedo.clamp(0, 1), normal.clamp(-1, 1))
        assert torch.equal(denoise(color, albedo, normal), expected)

    @pytest.mark.parametrize("spec", MODES)
    def test_a_normal_without_an_albedo_is_left_out(self, spec: str) -> None:
        color, normal = image(40, 40) * 5, image(40, 40, 2)
        denoise = denoisers.create(spec)
        assert torch.equal(denoise(color, None, normal), denoise(color))
        assert not torch.equal(denoise(color, normal.abs(), normal), denoise(color, normal.abs()))


def reference_oidn(color: torch.Tensor, features: dict[str, torch.Tensor], *, prefilter: bool) -> torch.Tensor:
    """What OIDN's documentation says of ``cleanAux``, with the bindings alone."""
    device = Device(DeviceType.CPU)
    device.num_threads = 1

    def filtered(images: dict[str, torch.Tensor], **flags: bool) -> torch.Tensor:
        output = torch.empty_like(next(iter(images.values())))
        rt = device.new_filter("RT")
        for name, value in (images | {"output": output}).items():
            rt.set_image(name, value)
        for name, flag in flags.items():
            rt.set_bool(name, flag)
        rt.execute()
        return output

    if prefilter:
        features = {name: filtered({name: value}) for name, value in features.items()}
    return filtered({"color": color} | features, hdr=True, cleanAux=True)


class TestPrefiltering:
    """``oidn`` denoises albedo and normal first, once for all images that go with them."""

    color, albedo, normal = image(48, 64) * 5, image(48, 64, 1), image(48, 64, 2) * 2 - 1

    @pytest.mark.parametrize(("spec", "prefilter"), [("oidn", True), ("oidn:fast", False)])
    @pytest.mark.parametrize("names", [("albedo",), ("albedo", "normal")])
    def test_it_is_what_the_documentation_says(self, spec: str, prefilter: bool, names: tuple[str, ...]) -> None:
        features = {name: getattr(self, name) for name in names}
        expected = reference_oidn(self.color, features, prefilter=prefilter)
        assert torch.equal(denoisers.create(spec, threads=1)(self.color, **features), expected)

    def test_the_three_differ_with_features_and_only_then(self) -> None:
        three = [denoisers.create(spec, threads=1) for spec in MODES]
        accurate, fast, none = (denoise(self.color, self.albedo, self.normal) for denoise in three)
        assert not torch.equal(accurate, fast)
        assert not torch.equal(fast, none)
        accurate, fast, none = (denoise(self.color) for denoise in three)
        assert torch.equal(accurate, fast)
        assert torch.equal(fast, none)

    def test_half_floats_stay_half_floats(self) -> None:
        denoise = denoisers.create("oidn", threads=1)
        albedo, normal = denoise.prefilter(self.albedo.half(), self.normal.half())
        assert isinstance(albedo, torch.Tensor)
        assert isinstance(normal, torch.Tensor)
        assert albedo.dtype == normal.dtype == torch.float16
        torch.testing.assert_close(denoise.prefilter(self.albedo.half().float())[0], albedo.float(), rtol=1e-3, atol=0)

    def test_odd_sizes_are_padded_and_cropped(self) -> None:
        albedo, normal = self.albedo[:37, :41], self.normal[:37, :41]
        clean = denoisers.create("oidn", threads=1).prefilter(albedo, normal)
        mirror = [mirrored(feature, bottom=11, right=7) for feature in (albedo, normal)]
        for result, expected in zip(clean, PrefilteringOidn(1).prefilter(*mirror), strict=True):
            assert isinstance(result, torch.Tensor)
            assert isinstance(expected, torch.Tensor)
            assert torch.equal(result, expected[:37, :41])

    def test_a_frame_prefilters_each_half_and_their_mean_once(self) -> None:
        seen: list[str] = []

        class Counting(PrefilteringOidn):
            def _filtered(self, images: dict[str, torch.Tensor], *, hdr: bool, clean_aux: bool) -> torch.Tensor:
                seen.append(" ".join(images))
                return super()._filtered(images, hdr=hdr, clean_aux=clean_aux)

        denoise = Denoise(Counting(1))
        color = self.color, image(48, 64, 3) * 5
        albedo, normal = (self.albedo, image(48, 64, 4)), (self.normal, image(48, 64, 5) * 2 - 1)
        frame = Frame(color, albedo=albedo, normal=normal).denoise(denoise)
        assert seen == ["albedo", "normal", "color albedo normal"] * 3
        assert frame.denoised is not None
        assert torch.equal(frame.denoised[1], denoise(color[1], albedo[1], normal[1]).clamp(min=0))
        means = ((a + b) / 2 for a, b in (color, albedo, normal))
        torch.testing.assert_close(frame.denoised_full, denoise(*means).clamp(min=0), **near("OIDN of the mean"))

        seen.clear()
        sub_images = SubImages.of(frame, (color[0], color[0], color[1], color[1]))
        assert sub_images.denoise(frame, denoise).denoised is not None
        assert seen == ["albedo", "normal", *["color albedo normal"] * 2] * 2
        seen.clear()
        Frame(color, albedo=albedo).denoise(denoise)
        assert seen == ["albedo", "color albedo"] * 3
        seen.clear()
        Frame(color).denoise(denoise)
        assert seen == ["color"] * 3

    def test_a_prefilter_that_returns_rubbish_is_refused_by_name(self) -> None:
        class Broken(PrefilteringOidn):
            def prefilter(
                self, albedo: torch.Tensor | None, normal: torch.Tensor | None
            ) -> tuple[torch.Tensor | None, torch.Tensor | None]:
                return None if albedo is None else albedo * torch.nan, normal

        with pytest.raises(DenoiserError, match="denoiser oidn: expected a finite float tensor"):
            Denoise(Broken(1))(self.color, self.albedo)
