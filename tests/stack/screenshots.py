"""Takes the pictures of infra/pictures: MLflow's pages of real runs, in a headless browser.

`python -m tests.stack.screenshots [OUTPUT]` starts the servers of the compose file, trains three short runs
through them, names a champion and takes the pictures. Needs Chromium (`CHROMIUM` names its program).
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aiohttp
from PIL import Image

from tests.stack.compose import ROOT
from tests.stack.servers import Stack

SIZE = (1440, 900)
COLORS = 128
"""Colours of a picture: pages have few, and files stay small."""

COLUMNS = [
    "metrics.`val/psnr_wskp`", "metrics.`val/ssim_wskp`", "params.`model.init_args.loss.class_path`",
    "params.`model.init_args.optimizer.init_args.lr`",
]  # fmt: skip
CHARTS = "val/(psnr|ssim|smape)_wskp$"
RUNS = {"loss: SMAPE, lr 0.004": (), "lr 0.016": ("--model.init_args.optimizer.init_args.lr", "0.016"),
        "L1": ("--model.init_args.loss", "trainer.losses.L1")}  # fmt: skip
OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--trainer.max_epochs", "4", "--trainer.limit_train_batches", "12",
    "--trainer.log_every_n_steps", "1",
)  # fmt: skip


class Browser:
    """One page of a headless Chromium, driven by its debugging protocol."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._number = 0

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        self._number += 1
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        async for message in self._socket:
            answer = message.json()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
        raise RuntimeError("the browser closed the connection")

    async def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression on the page."""
        answer = await self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    async def show(self, address: str, wanted: str, wait_s: float = 90.0) -> None:
        """Open a page and wait until a text is on it and pictures have come."""
        await self.call("Page.navigate", url="about:blank")
        await self.call("Page.navigate", url=address)
        deadline = time.monotonic() + wait_s
        while wanted not in (await self.run("document.body ? document.body.innerText : ''") or ""):
            if time.monotonic() > deadline:
                text = await self.run("document.body.innerText")
                raise TimeoutError(f"{address} does not show {wanted!r} but:\n{text}")
            await asyncio.sleep(0.5)
        await asyncio.sleep(4)

    async def click(self, selector: str, text: str) -> None:
        """Press and release the mouse on the first element of a CSS selector that begins with a text."""
        box = await self.run(
            f"(() => {{ const found = [...document.querySelectorAll({selector!r})].find(e => (e.innerText || "
            f"e.placeholder || '').trim().startsWith({text!r})); "
            "const box = found?.getBoundingClientRect(); "
            "return box && [box.x + Math.min(box.width / 2, 60), box.y + box.height / 2]; })()"
        )
        if not box:
            raise LookupError(f"the page has no {selector} {text!r}")
        for kind in ("mousePressed", "mouseReleased"):
            await self.call(
                "Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1
            )
        await asyncio.sleep(3)

    async def write(self, text: str) -> None:
        """Type a text into the field that was clicked."""
        await self.call("Input.insertText", text=text)

    async def wait_for(self, selector: str, count: int, wait_s: float = 90.0) -> None:
        """Wait until so many elements of a CSS selector are there."""
        deadline = time.monotonic() + wait_s
        while await self.run(f"document.querySelectorAll({selector!r}).length") < count:
            if time.monotonic() > deadline:
                raise TimeoutError(f"the page has fewer than {count} {selector}")
            await asyncio.sleep(0.5)
        await asyncio.sleep(4)

    async def take(self, path: Path, height: int = SIZE[1]) -> None:
        """Write the upper part of what is seen as a PNG of few colours."""
        clip = {"x": 0, "y": 0, "width": SIZE[0], "height": height, "scale": 1}
        shot = await self.call("Page.captureScreenshot", format="png", clip=clip)
        picture = Image.open(io.BytesIO(base64.b64decode(shot["data"]))).convert("RGB")
        picture.quantize(COLORS, dither=Image.Dither.NONE).save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


async def with_browser(visit: Callable[[Browser], Any], account: tuple[str, str]) -> None:
    """Start a browser that shows the account on every request, let `visit` use it, end it."""
    profile = Path(tempfile.mkdtemp(prefix="penumbra-browser-"))
    program = os.environ.get("CHROMIUM", "chromium")
    process = subprocess.Popen(
        [program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync",
         "--hide-scrollbars", "--remote-debugging-port=0", f"--user-data-dir={profile}",
         f"--window-size={SIZE[0]},{SIZE[1]}", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        port = await _port(profile / "DevToolsActivePort")
        async with aiohttp.ClientSession() as session:
            async with session.get(f"http://127.0.0.1:{port}/json") as answer:
                page = next(entry for entry in await answer.json() if entry["type"] == "page")
            async with session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                browser = Browser(socket)
                token = base64.b64encode(":".join(account).encode()).decode()
                await browser.call("Network.enable")
                await browser.call("Network.setExtraHTTPHeaders", headers={"Authorization": f"Basic {token}"})
                await browser.call(
                    "Emulation.setDeviceMetricsOverride",
                    width=SIZE[0], height=SIZE[1], deviceScaleFactor=1, mobile=False,
                )  # fmt: skip
                await visit(browser)
    finally:
        process.terminate()
        process.wait(20)
        shutil.rmtree(profile, ignore_errors=True)


async def _port(file: Path) -> int:
    for _ in range(120):
        if file.exists() and (text := file.read_text()):
            return int(text.splitlines()[0])
        await asyncio.sleep(0.25)
    raise TimeoutError("the browser does not start; set CHROMIUM to its program")


def train(folder: Path, environment: dict[str, str]) -> None:
    """Train the runs that the pictures show."""
    for name, options in RUNS.items():
        print(f"training: {name}", flush=True)
        subprocess.run(
            [sys.executable, "-m", "trainer", "fit", *OPTIONS, *options], cwd=folder, check=True,
            env=os.environ | environment | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip


def preferences(experiment: str) -> str:
    """Return a script that sets what MLflow remembers of a person's choices."""
    page = f'MLflowLocalStorage-1.1-ExperimentPage-["{experiment}"]-ReactComponentState'
    state = {"orderByKey": "attributes.start_time", "orderByAsc": False, "selectedColumns": COLUMNS}
    chosen = {
        "mlflow.workflowType_v1": '"machine_learning"',
        "mlflow.assistant.fab.autoOpenedOnFirstLoad_v1": "true",
        "mlflow.assistant.panelOpen_v1": "false",
        page: json.dumps(state),
    }
    return f"Object.entries({json.dumps(chosen)}).forEach(([key, value]) => localStorage.setItem(key, value))"


def _step(path: str) -> tuple[int, str]:
    found = re.search(r"\+step\+(\d+)", path)
    return (int(found[1]) if found else -1, path)


async def take_all(uri: str, account: tuple[str, str], output: Path) -> None:
    """Take the pictures of the runs on a server."""
    from mlflow.tracking import MlflowClient

    client = MlflowClient(uri, uri)
    experiment = client.get_experiment_by_name("wskp_bmfr").experiment_id
    runs = client.search_runs([experiment])
    first, name = runs[-1].info.run_id, runs[-1].info.run_name
    pictures = [entry.path for entry in client.list_artifacts(first, "images") if entry.path.endswith(".png")]
    base = f"{uri}/#/experiments/{experiment}/runs"

    async def visit(browser: Browser) -> None:
        await browser.call("Page.enable")
        await browser.call("Page.addScriptToEvaluateOnNewDocument", source=preferences(experiment))
        await browser.show(base, name)
        await browser.take(output / "runs.png", height=440)
        await browser.show(f"{base}?compareRunsMode=CHART", "throughput")
        await browser.run("document.head.append(Object.assign(document.createElement('style'), "
                          "{textContent: '.modebar {display: none}'}))")  # fmt: skip
        await browser.click("input", "Search metric charts")
        await browser.write(CHARTS)
        await asyncio.sleep(3)
        await browser.wait_for(".js-plotly-plot", 3)
        await browser.take(output / "charts.png")
        await browser.show(f"{uri}/#/models/wskp", "champion")
        await browser.take(output / "registry.png", height=520)
        await browser.show(f"{base}/{first}/artifacts", "images")
        await browser.click("span, div", "images")
        await browser.click("span, div", Path(max(pictures, key=_step)).name)
        await asyncio.sleep(4)
        await browser.take(output / "artifacts.png")

    await with_browser(visit, account)


def main() -> None:
    """Train and take the pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", nargs="?", type=Path, default=ROOT / "infra" / "pictures")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="penumbra-pictures-") as name,
        Stack(Path(name) / "stack") as stack,
    ):
        work = Path(name) / "work"
        work.mkdir()
        train(work, stack.environment)
        os.environ.update(stack.environment)
        from mlflow.tracking import MlflowClient

        client = MlflowClient(stack.tracking_uri, stack.tracking_uri)
        client.set_registered_model_alias("wskp", "champion", "3")
        account = (os.environ["MLFLOW_TRACKING_USERNAME"], os.environ["MLFLOW_TRACKING_PASSWORD"])
        asyncio.run(take_all(stack.tracking_uri, account, args.output))


if __name__ == "__main__":
    main()
