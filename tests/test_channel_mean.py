"""The mean over few channels: torch's own bits, faster."""

import pytest
import torch

from selfcorrect.image.channels import channel_mean


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_the_bits_are_torchs_own(channels: int, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(channels)
    image = torch.randn(67, 131, channels, generator=generator, dtype=dtype)
    image *= torch.randn(67, 131, 1, generator=generator, dtype=dtype).mul(8).exp()
    before = image.clone()
    assert torch.equal(channel_mean(image), image.mean(-1))
    assert torch.equal(image, before)
