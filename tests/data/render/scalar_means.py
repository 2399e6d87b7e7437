"""Print mean and standard error of the box's samples in the scalar variant; run as a child process."""

import numpy as np

from data.render.tracer import Tracer
from data.render.variant import activate, choose
from tests.data.render import scenes
from tests.data.render.test_second_hits import BLACK, RED, diffuse, facing


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
    _check_second_hits()
    for name, values in {**chunk.values, "alone": alone.values["radiance"]}.items():
        means = values.astype(np.float64).mean((1, 2, 3))
        print(f"{name}={means.mean()}/{means.std(ddof=1) / np.sqrt(len(means))}")


def _check_second_hits() -> None:
    names = ("second_albedo", "hit")
    (shown,) = Tracer(facing(diffuse(RED))).trace(0, 1, 1, names)
    assert np.array_equal(shown.values["second_albedo"], shown.values["hit"] * np.array(RED, np.float32))
    (ended,) = Tracer(facing(diffuse(RED), BLACK)).trace(0, 1, 1, names)
    assert ended.values["hit"].max() == 1
    assert (ended.values["second_albedo"] == 0).all()


if __name__ == "__main__":
    main()
