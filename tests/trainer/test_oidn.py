import sys

import pytest
import torch

from tests.models.frames import split_buffers
from trainer.loading import resolve
from trainer.metrics.functional import psnr_wskp
from trainer.oidn import OIDN


@pytest.fixture(scope="module")
def scene():
    """A smooth image with noise, its guides, and the smooth image."""
    generator = torch.Generator().manual_seed(0)
    buffers = {name: split_buffers(1, 64, 80)[name] for name in ("albedo", "normal")}
    smooth = torch.nn.functional.interpolate(
        torch.rand(1, 3, 4, 5, generator=generator), (64, 80), mode="bilinear"
    )
    spread = -torch.log1p(-torch.rand(1, 3, 64, 80, generator=generator))
    return {"color": smooth * spread, **{n: torch.ones_like(t) * 0.5 for n, t in buffers.items()}}, smooth


@pytest.mark.parametrize("auxiliary", ["noisy", "clean", "prefiltered", "none"])
@pytest.mark.parametrize("quality", ["high", "fast"])
def test_noise_becomes_less_in_every_mode(scene, auxiliary, quality):
    buffers, smooth = scene
    color = OIDN(auxiliary, quality)(buffers).color
    assert color.shape == smooth.shape
    assert float(psnr_wskp(color, smooth)) > float(psnr_wskp(buffers["color"], smooth)) + 6


def test_images_of_a_batch_do_not_influence_each_other(scene):
    buffers, _ = scene
    other = {name: image.flip(-1) for name, image in buffers.items()}
    both = OIDN()({name: torch.cat([image, other[name]]) for name, image in buffers.items()}).color
    alone = torch.cat([OIDN()(buffers).color, OIDN()(other).color])
    torch.testing.assert_close(both, alone)


def test_modes_use_the_guides_differently(scene):
    buffers, _ = scene
    generator = torch.Generator().manual_seed(1)
    buffers = buffers | {"albedo": torch.rand(1, 3, 64, 80, generator=generator)}
    made = [OIDN(kind)(buffers).color for kind in ("noisy", "clean", "prefiltered", "none")]
    for place, image in enumerate(made):
        assert all(not torch.equal(image, other) for other in made[:place])


def test_it_is_named_like_the_other_methods_and_takes_options():
    loaded = resolve("OIDN", options=["quality=fast", "auxiliary=none"])
    assert (loaded.model.quality, loaded.model.inputs) == ("fast", ("color",))


def test_wrong_options_are_refused_with_what_there_is():
    with pytest.raises(ValueError, match="noisy, clean, prefiltered, none"):
        OIDN("sharp")


def test_without_the_library_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(ValueError, match=r"penumbra-denoise\[oidn\]"):
        OIDN()
