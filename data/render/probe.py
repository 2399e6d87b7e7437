"""Trace a few samples with the LLVM library of the environment: run as a child, which may be killed by it."""

from __future__ import annotations

import os

from data.render.spec import SceneSpec, View
from data.render.variant import LIBRARY, Variant, activate


def scene() -> SceneSpec:
    """Return a scene of a few shapes that uses what real ones use."""
    import numpy as np

    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned[2, 3] = 5.0
    metal = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    content = {
        "metal": {"type": "sphere", "bsdf": metal},
        "floor": {"type": "rectangle", "bsdf": {"type": "twosided", "inner": {"type": "roughplastic"}}},
        "sky": {"type": "constant"},
        "lamp": {"type": "sphere", "center": [0.0, 3.0, 0.0], "emitter": {"type": "area"}},
    }
    view = View(turned, 45.0, 8, 8, aperture=0.1, focus=5.0)
    return SceneSpec("probe", content, (view,))


def main() -> int:
    """Print `works` if samples come out finite and bright."""
    import numpy as np

    activate(Variant("llvm_ad_rgb", os.environ[LIBRARY], ""), threads=1)
    from data.render.tracer import GUIDES, Tracer

    chunks = list(Tracer(scene()).trace(0, 4, 1, ("radiance", "diffuse", *GUIDES)))
    means = [float(np.mean(values)) for chunk in chunks for values in chunk.values.values()]
    radiance = float(np.mean(chunks[0].values["radiance"]))
    if not (np.isfinite(means).all() and 0.2 < radiance < 2.0):
        print(f"a small render gave {radiance}")
        return 1
    print("works")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
