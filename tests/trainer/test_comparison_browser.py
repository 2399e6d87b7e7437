"""The report of an evaluation in headless Chromium: what a person sees and does."""

import shutil

import numpy as np
import pytest
from playwright.sync_api import sync_playwright

from tests.trainer.comparison_folder import make_folder, methods_of
from trainer.reports.comparison import write_page
from trainer.reports.comparison.levels import FLOOR
from trainer.reports.pictures import GAMMA, colors

pytestmark = pytest.mark.slow

SIZE = HEIGHT, WIDTH = 48, 64
EXPOSURE = 0.8

# The color of a pixel of the picture on the large canvas, where the whole picture is shown.
FITTED = """([x, y, w, h]) => {
  const c = document.getElementById("canvas"), s = Math.min(c.width / w, c.height / h);
  const left = Math.round((c.width - w * s) / 2), top = Math.round((c.height - h * s) / 2);
  const at = [left + (x + 0.5) * s, top + (y + 0.5) * s], box = c.getBoundingClientRect();
  const copy = new OffscreenCanvas(1, 1).getContext("2d");
  copy.drawImage(c, -Math.floor(at[0]), -Math.floor(at[1]));
  const color = copy.getImageData(0, 0, 1, 1).data;
  const ratio = box.width / c.width;
  return { color: [...color].slice(0, 3), x: box.left + at[0] * ratio, y: box.top + at[1] * ratio };
}"""


@pytest.fixture(scope="module")
def browser():
    program = shutil.which("chromium")
    assert program, "these tests need the Debian package chromium: apt-get install chromium"
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """A page, and label, frame → the radiance in its file."""
    files = {}

    def write(label, name, radiance):
        if label == "method 1":
            radiance[5, 7] = (np.nan, 1, np.inf)
        files[label, name] = radiance
        return radiance

    skipped = methods_of(
        1, label="KPCN", folder="KPCN", status="skipped", reason="needs diffuse and specular", cost=None
    )
    folder = make_folder(tmp_path_factory.mktemp("page"), frames=2, size=SIZE, extra=skipped, write=write)
    return write_page(folder), files


class Visit:
    """A tab that shows a page and remembers what it complains of and asks for."""

    def __init__(self, browser, path, script="", **options):
        self.context = browser.new_context(**{"viewport": {"width": 1440, "height": 900}, **options})
        self.context.add_init_script(script)
        self.page, self.complaints, self.requests = self.context.new_page(), [], []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.settle()

    def settle(self):
        """Wait until what was asked for is drawn."""
        self.page.wait_for_timeout(60)
        while not self.page.evaluate("document.getElementById('busy').hidden"):
            self.page.wait_for_timeout(30)
        self.page.wait_for_timeout(60)

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)
        self.settle()

    def at(self, x, y):
        return self.page.evaluate(FITTED, [x, y, WIDTH, HEIGHT])

    def color(self, x, y):
        return np.array(self.at(x, y)["color"])

    def point(self, x, y):
        place = self.at(x, y)
        self.page.mouse.move(place["x"], place["y"])
        self.settle()

    def values(self):
        """Return label → the texts of its row below the picture."""
        rows = self.page.locator("#readout tbody tr").evaluate_all(
            "rows => rows.map(r => [r.cells[0].textContent, [...r.cells].slice(1).map("
            "c => c.dataset.value ?? c.textContent)])"
        )
        return dict(rows)


@pytest.fixture
def visit(browser, evaluation):
    made = Visit(browser, evaluation[0])
    yield made
    made.context.close()
    assert made.complaints == []


def gamma(radiance, stops=0.0):
    return 255 * np.clip(radiance * EXPOSURE * 2.0**stops, 0, 1) ** GAMMA


def test_the_page_loads_nothing_and_says_what_was_skipped(visit, evaluation):
    assert [url for url in visit.requests if not url.startswith("blob:")] == [evaluation[0].as_uri()]
    assert "KPCN skipped: needs diffuse and specular" in visit.page.inner_text("#troubles")
    assert "at most 0.5 %" in visit.page.inner_text("#exactness")


def test_values_under_the_pointer_are_those_of_the_files_within_the_bound(visit, evaluation):
    visit.press("1", "2", "3")
    visit.point(40, 12)

    found = visit.values()

    for label in ("input", "method 0", "method 1"):
        wanted = evaluation[1][label, "hall/f000"][12, 40]
        bound = 0.01 if label == "input" else 0.005
        values = np.array([float(v) for v in found[label][:3]])
        assert (np.abs(values - wanted) <= bound * (wanted + FLOOR / EXPOSURE) * 1.0001).all(), label


def test_values_that_are_no_numbers_are_named_and_painted(visit):
    visit.press("3")
    visit.point(7, 5)

    values = visit.values()["method 1"]

    assert values[0] == "NaN"
    assert float(values[1]) == pytest.approx(1, rel=0.006)
    assert values[2] == "+Inf"
    assert visit.color(7, 5).tolist() == [255, 0, 255]


def test_keys_show_another_picture_at_the_same_place(visit, evaluation):
    files = evaluation[1]

    def shows(label):
        return np.abs(visit.color(20, 30) - gamma(files[label, "hall/f000"][30, 20])).max() <= 2

    assert shows("method 0")
    visit.press("1")
    assert shows("input")
    visit.press("ArrowRight", "ArrowRight")
    assert shows("method 1")
    visit.press(" ")
    assert shows("method 0")
    visit.press("Shift+1", " ")
    assert shows("input")
    visit.press(" ")
    assert shows("method 0")
    visit.press(".")
    assert np.abs(visit.color(20, 30) - gamma(files["method 0", "hall/f001"][30, 20])).max() <= 2


def test_browsers_without_workers_for_local_files_show_the_same_values(browser, visit, evaluation):
    plain = Visit(browser, evaluation[0], script="delete window.Worker")
    for tab in (visit, plain):
        tab.point(40, 12)

    assert plain.values()["method 0"] == visit.values()["method 0"]
    assert plain.complaints == []
    plain.context.close()


def test_zoom_and_place_stay_when_pictures_take_turns(visit):
    visit.press("+", "+", "+", "Shift+ArrowRight")

    def shown():
        return visit.page.evaluate("document.getElementById('canvas').toDataURL()")

    before = visit.page.inner_text("#zoom-text"), shown()

    visit.press("2", "1", "2")

    assert visit.page.inner_text("#zoom-text") == before[0] != "fit"
    assert shown() == before[1]


def test_zoomed_in_every_pixel_is_a_square_of_one_color(visit):
    visit.press("1", "+", "+", "+")
    square = visit.page.evaluate("""() => {
      const c = document.getElementById("canvas"), copy = new OffscreenCanvas(300, 1).getContext("2d");
      copy.drawImage(c, -c.width / 2, -c.height / 2);
      return [...copy.getImageData(0, 0, 300, 1).data];
    }""")
    row = np.array(square).reshape(-1, 4)
    edges = np.flatnonzero((np.diff(row, axis=0) != 0).any(1))
    zoom = float(visit.page.inner_text("#zoom-text").rstrip("×"))

    assert zoom > 50
    assert len(edges) >= 2
    assert np.allclose(np.diff(edges), zoom, atol=1.1)


def test_exposure_and_curve_act_on_radiance(visit, evaluation):
    radiance = evaluation[1]["method 0", "hall/f000"]
    x, y = 33, 14  # in the lamp: white until the exposure falls
    assert radiance[y, x].min() * EXPOSURE > 2
    assert visit.color(x, y).tolist() == [255, 255, 255]

    visit.page.fill("#stops", "-6")
    visit.settle()
    assert np.abs(visit.color(x, y) - gamma(radiance[y, x], -6)).max() <= 2

    for name, curve in (("srgb", lambda v: v), ("log", np.log1p)):
        visit.page.select_option("#curve", name)
        visit.settle()
        value = curve(radiance[y, x] * EXPOSURE / 64)
        wanted = 255 * np.clip(1.055 * value ** (1 / 2.4) - 0.055, 0, 1)
        assert np.abs(visit.color(x, y) - wanted).max() <= 2


def test_left_of_the_divider_is_one_picture_and_right_of_it_the_other(visit, evaluation):
    visit.press("1", "Shift+2", "s")
    files = evaluation[1]

    def off(label, x, y=30):
        return np.abs(visit.color(x, y) - gamma(files[label, "hall/f000"][y, x])).max()

    assert off("input", 20) <= 2
    assert off("method 0", 44) <= 2
    assert off("input", 44) > 5

    handle = visit.page.locator("#divider").bounding_box()
    visit.page.mouse.move(handle["x"] + 22, handle["y"] + 30)
    visit.page.mouse.down()
    visit.page.mouse.move(handle["x"] + 500, handle["y"] + 30)
    visit.page.mouse.up()
    visit.settle()

    assert off("input", 44) <= 2
    before = int(visit.page.get_attribute("#divider", "aria-valuenow"))
    visit.page.focus("#divider")
    visit.press("ArrowLeft")
    assert int(visit.page.get_attribute("#divider", "aria-valuenow")) == before - 2


def test_error_maps_show_the_error_of_each_pixel(visit, evaluation):
    files = evaluation[1]
    visit.press("1", "m")
    visit.point(20, 30)
    one, target = files["input", "hall/f000"][30, 20] * EXPOSURE, files["method 0", "hall/f000"]

    shown = float(visit.values()["input"][3])

    reference = np.array([float(v) for v in visit.values()["reference"][:3]]) * EXPOSURE
    error = float(np.mean((one - reference) ** 2 / (reference**2 + 0.01)))
    assert shown == pytest.approx(error, rel=0.1)
    wanted = colors()[int(np.clip(np.rint((np.log10(error) + 3) / 4 * 255), 0, 255))]
    assert np.abs(visit.color(20, 30) - wanted).max() <= 25
    assert "relMSE" in visit.page.inner_text("#colorbar")

    visit.press("m")
    visit.point(21, 30)
    assert 0 <= float(visit.values()["input"][4]) <= 1
    assert "FLIP" in visit.page.inner_text("#colorbar")
    assert target.shape == (*SIZE, 3)


def test_crops_show_the_same_place_of_all_pictures_and_move_together(visit):
    visit.page.select_option("#crop-size", "32")
    visit.page.locator("#crops-card").scroll_into_view_if_needed()
    visit.settle()

    def seen():
        return visit.page.evaluate("""() => [...document.querySelectorAll("#crops figure")].map((figure) => {
          const c = figure.querySelector("canvas");
          const copy = new OffscreenCanvas(c.width, c.height).getContext("2d");
          copy.drawImage(c, 0, 0);
          return [...copy.getImageData(0, 0, c.width, c.height).data];
        })""")

    before = seen()
    box = visit.page.locator("#crops figure canvas").first.bounding_box()
    visit.page.mouse.move(box["x"] + 100, box["y"] + 100)
    visit.page.mouse.down()
    visit.page.mouse.move(box["x"] + 160, box["y"] + 100)
    visit.page.mouse.up()
    visit.settle()
    after = seen()

    assert len(before) == 4
    assert all(len(one) == 32 * 32 * 4 for one in before)
    assert all(one != other for one, other in zip(before, after, strict=True))


def test_tables_sort_by_a_click_and_missing_values_come_last(visit):
    button = visit.page.locator("#table thead button").nth(1)

    def column():
        return visit.page.locator("#table tbody tr").evaluate_all(
            "rows => rows.map(r => r.cells[1].dataset.value)"
        )

    orders = []
    for order in ("ascending", "descending"):
        button.click()
        assert visit.page.locator("#table th[aria-sort]").get_attribute("aria-sort") == order
        orders.append(column())

    assert [values[-2:] for values in orders] == [["", ""]] * 2  # NaN in one, nothing of the other
    rising, falling = ([float(v) for v in values[:-2]] for values in orders)
    assert len(rising) == 2
    assert rising == sorted(rising)
    assert falling == sorted(falling, reverse=True)
    assert visit.page.locator("#table td.best").count() == 1


def test_plots_show_convergence_and_time_against_quality(visit):
    titles = visit.page.locator("#plot-area figcaption").all_inner_texts()

    assert [title.split(" ")[0] for title in titles] == ["psnr_wskp", "Time"]
    assert visit.page.locator("#plot-area path.front").count() == 1


def test_on_a_phone_nothing_is_wider_than_the_screen_and_fingers_zoom(browser, evaluation):
    phone = Visit(
        browser, evaluation[0], viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True
    )

    assert phone.page.evaluate("document.documentElement.scrollWidth") == 390

    phone.page.locator("#canvas").scroll_into_view_if_needed()
    box, session = phone.page.locator("#canvas").bounding_box(), phone.context.new_cdp_session(phone.page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for kind, apart in (("touchStart", 20), ("touchMove", 30), ("touchMove", 60), ("touchMove", 80)):
        points = [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    phone.settle()
    assert phone.page.inner_text("#zoom-text") != "fit"
    assert phone.complaints == []
    phone.context.close()


@pytest.mark.parametrize(
    ("case", "options"),
    [
        ("no reference", {"reference": False}),
        ("one frame, one method", {"frames": 1, "methods": 1, "spps": (1,)}),
        ("40 frames", {"frames": 20, "methods": 1, "spps": (None,)}),
        (
            "nothing finite",
            {"frames": 1, "write": lambda label, name, x: x if label == "input" else x * np.nan},
        ),
        (
            "only failures",
            {
                "frames": 1,
                "methods": 0,
                "extra": methods_of(1, folder="none", status="failed", reason="it broke"),
            },
        ),
        (
            "long names",
            {"frames": 1, "methods": methods_of(2, label="models:/a-very-long-name-of-a-model/" * 4)[:1]},
        ),
    ],
)
def test_unusual_evaluations_are_shown_without_a_complaint(browser, tmp_path, case, options):
    visit = Visit(browser, write_page(make_folder(tmp_path, **{"size": (16, 24), **options})))
    visit.press("1", "2", "m", " ", "s", "+", ".")

    narrow = Visit(browser, tmp_path / "report.html", viewport={"width": 390, "height": 844})

    assert narrow.page.evaluate("document.documentElement.scrollWidth") == 390
    assert visit.complaints == narrow.complaints == []
    assert visit.page.get_attribute("#kinds [data-kind=flip]", "disabled") == (
        "" if case == "no reference" else None
    )
    for tab in (visit, narrow):
        tab.context.close()
