"""Print mean and standard error of the box's samples in the scalar variant; run as a child process."""

import numpy as np

from data.render.tracer import Tracer
from data.render.variant import activate, choose
from tests.data.render import scenes


def main() -> None:
    activate(choose("scalar_rgb"), threads=2)
    tracer = Tracer(scenes.box(8, 8))
    names = ("radiance", "diffuse", "depth", "hit")
    (chunk,) = tracer.trace(0, 32, 1, (*names, "second_albedo"))
    (without,) = tracer.trace(0, 32, 1, names)
    assert all(np.array_equal(without.values[name], chunk.values[name]) for name in names)
    (alone,) = tracer.trace(0, 256, 2, ("radiance",))
    (again,) = tracer.trace(0, 256, 2, ("radiance",))
    assert np.array_equal(alone.values["radiance"], again.values["radiance"])
    for name, values in {**chunk.values, "alone": alone.values["radiance"]}.items():
        means = values.astype(np.float64).mean((1, 2, 3))
        print(f"{name}={means.mean()}/{means.std(ddof=1) / np.sqrt(len(means))}")


if __name__ == "__main__":
    main()
