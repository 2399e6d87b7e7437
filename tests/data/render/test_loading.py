"""What Mitsuba makes of a scene."""

from data.render import loading
from data.render.random_scenes import random_scene
from data.render.spec import Shot
from tests.data.render import scenes


def test_things_and_lights_come_in_the_order_of_the_scene():
    """The same random numbers choose another light where they do not."""
    scenes.activate()
    spec = random_scene(2, "indoor", Shot(32, 32, defocus=0.0, motion=0.0))
    assert isinstance(spec.content, dict)
    scene = loading.load(spec).scene
    made = [thing.id() for thing in scene.shapes()]
    assert len(made) > 10
    assert made == [name for name in spec.content if name in made]
    lights = [light.get_shape().id() for light in scene.emitters() if light.get_shape()]
    assert len(lights) > 1
    assert lights == [name for name in made if name in lights]


def test_meshes_of_one_material_stay_apart():
    scenes.activate()
    content = {
        "one": {"type": "mesh", "mesh": scenes.cube((-1, 0, 0), 0.5), "bsdf": scenes.GREY},
        "two": {"type": "mesh", "mesh": scenes.cube((1, 0, 0), 0.5), "bsdf": scenes.GREY},
    }
    scene = loading.load(scenes.SceneSpec("cubes", content, (scenes.view(),))).scene
    assert [thing.id() for thing in scene.shapes()] == ["one", "two"]
