"""Folders of evaluations with made-up pictures and scores, as `trainer evaluate` leaves them."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from data.exr_image import write_exr
from trainer.metrics.measures import SCORES

METRICS = ("psnr_wskp", "relmse_rousselle", "flip_ldr_srgb")


def scene_picture(height, width, seed):
    """Return smooth radiance with edges, a lamp and black corners, (H, W, 3) float32."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
    image = ((0.6 + 0.4 * np.sin(7 * x + 0.5 + seed)) * (0.5 + 0.4 * np.cos(5 * y + 0.5)))[..., None]
    tint = generator.uniform(0.2, 1.0, 3)
    image = image * tint + ((x * 6).astype(int) % 2 == (y * 4).astype(int) % 2)[..., None] * 0.25
    image[(x - 0.5) ** 2 + (y - 0.3) ** 2 < 0.01] = (40.0, 30.0, 20.0)
    image[(x < 0.1) & (y < 0.1)] = 0
    return image.astype(np.float32)


def methods_of(count, **others):
    """Return entries of `evaluation.json`."""
    return [
        {
            "label": f"method {i}", "folder": f"method-{i}", "model": f"models:/m{i}/1",
            "class": "models.wskp.WSKP", "options": {"radius": i}, "status": "done", "reason": None,
            "parameters": 1000 * i, "run_url": None,
            "cost": {"seconds_per_megapixel": 0.05 * 3**i, "spread": [0.045 * 3**i, 0.06 * 3**i],
                     "peak_bytes_per_megapixel": 3e8 * (i + 1), "device": "cpu", "threads": 2},
            **others,
        }
        for i in range(count)
    ]  # fmt: skip


def make_folder(
    folder, frames=3, methods=2, size=(48, 64), reference=True, spps=(4, 16), extra=(), write=None
):
    """Write an evaluation of two scenes and return its folder.

    Args:
        folder: Where.
        frames: Per scene and number of samples.
        methods: How many have pictures, or entries.
        size: Height and width.
        reference: Whether frames have one.
        spps: Numbers of samples.
        extra: Entries of methods without pictures.
        write: Called with label, frame's name and radiance; returns the radiance to write.
    """
    folder, entries = Path(folder), methods if isinstance(methods, list) else methods_of(methods)
    listed, rows = [], []
    for scene in ("hall", "garden"):
        for index, spp in enumerate(s for s in spps for _ in range(frames)):
            name = f"{scene}/f{index:03d}"
            listed.append({"scene": scene, "index": index, "name": name, "spp": spp, "width": size[1],
                           "height": size[0], "exposure": 0.8, "reference": reference})  # fmt: skip
            rows += _write_frame(folder / "images", listed[-1], entries, write)
            rows += [_row(listed[-1], entry["label"], None) for entry in extra]
    record = {
        "penumbra": "0.1.0",
        "created": "2026-11-23T02:00:00+00:00",
        "data": {"root": "sample:bmfr", "split": "test"},
        "methods": [*entries, *extra],
        "metrics": [_metric(name) for name in METRICS],
        "frames": listed,
    }
    (folder / "evaluation.json").write_text(json.dumps(record))
    pd.DataFrame(rows).to_parquet(folder / "rows.parquet", index=False)
    return folder


def _metric(name):
    score = SCORES[name]
    return {"name": name, "higher": score.higher, "format": score.format, "definition": score.doc}


def _write_frame(images, frame, entries, write):
    height, width = frame["height"], frame["width"]
    target = scene_picture(height, width, len(frame["scene"]) + frame["index"] % 3)
    generator = np.random.default_rng(frame["index"])
    noise = generator.gamma((frame["spp"] or 4) / 4, 4 / (frame["spp"] or 4), (height, width, 1)).astype(
        np.float32
    )
    shown = {"input": ("input", target * noise)}
    for i, entry in enumerate(entries):
        shown[entry["label"]] = (
            entry["folder"],
            target * (0.7 + 0.3 * noise) if i % 2 else target * 0.5 + np.roll(target, 2, 1) * 0.5,
        )
    rows = []
    for label, (name, radiance) in shown.items():
        kept = write(label, frame["name"], radiance.copy()) if write else radiance
        if kept is not None:
            _write(images / name / f"{frame['name']}.exr", kept)
        rows.append(_row(frame, label, kept, target))
    if frame["reference"]:
        _write(images / "reference" / f"{frame['name']}.exr", target)
    return rows


def _write(path, radiance):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {letter: np.ascontiguousarray(radiance[..., i]) for i, letter in enumerate("RGB")})


def _row(frame, label, radiance, target=None):
    """Return a row whose scores are simple functions of the error; not those of the metrics' names."""
    values = dict.fromkeys(METRICS, float("nan"))
    lost = 0 if radiance is None else int((~np.isfinite(radiance)).any(-1).sum())
    if frame["reference"] and radiance is not None and not lost:
        error = float(np.mean((radiance - target) ** 2 / (target**2 + 0.01)))
        values = dict(
            zip(METRICS, (-10 * np.log10(error + 1e-6) + 20, error, min(1.0, error**0.5)), strict=True)
        )
    return {
        **{k: frame[k] for k in ("scene", "name", "spp", "width", "height", "exposure", "reference")},
        "method": label,
        "frame": frame["index"],
        "seconds": 0.01,
        "nonfinite": lost,
        "status": "done" if radiance is not None else "failed",
        "reason": None,
        **values,
    }
