"""Lower precision of the encoders: that it is used, is near, and leaves parameters and outputs as they were."""

import copy

import pytest
import torch

from pipeline.learn.network.encoders import CameraEncoder, LidarEncoder
from pipeline.learn.train.run import accelerate


@pytest.fixture(params=["camera", "lidar"])
def encoder(request):
    torch.manual_seed(3)
    return CameraEncoder(10, 4) if request.param == "camera" else LidarEncoder(4, 10, 4)


def test_bfloat16_is_near_float32_but_not_it_and_goes_in_and_out_as_float32(encoder):
    image = torch.rand(2, 4, 32, 64)
    half = copy.deepcopy(encoder)
    accelerate(half, half=True, compiled=False)
    plain, rounded = encoder(image), half(image)
    assert rounded.dtype == torch.float32
    assert all(p.dtype == torch.float32 for p in half.parameters())
    difference = (plain - rounded).abs().max() / plain.abs().max()
    assert 1e-5 < difference < 0.05  # eight bits: 0.4 % a layer
    for one in (encoder, half):
        one(image).square().mean().backward()
    # The direction of a step, not each weight: where thousands of pixels cancel, little is left to compare.
    one, two = (torch.cat([p.grad.ravel() for p in e.parameters()]) for e in (encoder, half))
    assert torch.nn.functional.cosine_similarity(one, two, 0) > 0.97
    assert half.state_dict().keys() == encoder.state_dict().keys()
