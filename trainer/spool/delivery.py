"""Brings the journal of a run to its tracking store, in order.

Everything can be sent twice: a metric has the time of its recording, and the store ignores one that it has
with the same key, step, time and value; parameters keep their first value; tags and files are replaced; runs
and models are looked for before they are made.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from trainer.runs import RunRecord
from trainer.spool.failures import Kind, OutageError, RefusedError, classify, reason
from trainer.spool.journal import SPOOL, Event, events, journal_size, shown
from trainer.spool.sent import Sent
from trainer.spool.store import described, experiment_id, open_client

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

T = TypeVar("T")
TAG = "penumbra.id"
"""Tag that names a run folder, by which its run is found again."""
GROUP = 2000
"""Numbers, parameters and tags that are gathered before they are sent."""
BATCHES = {"params": 50, "tags": 50, "metrics": 500}
"""How many a request takes, well below MLflow's limits on their number and on its size."""
LIMITS = {"params": 6000, "tags": 8000}
"""Longest values that a store takes, in characters."""


class Delivery:
    """Sends the journal of one run folder.

    Args:
        folder: Folder of the run.
        say: Prints a line for the user.
    """

    def __init__(self, folder: Path, say: Callable[[str], None] | None = None) -> None:
        self.folder = folder
        self.say = say or _print
        self.record = RunRecord.load(folder)
        self.uri = self.record.tracking_uri or ""
        self.sent = Sent.load(folder)
        self.counts = {"metrics": 0, "files": 0}
        self.limit: int | None = None
        """Bytes of the journal that may be sent, None for all of it; see `Sender.deliver_up_to`."""
        self._client: MlflowClient | None = None

    def step(self) -> int:
        """Send the next group of events; returns how many, 0 where all are sent.

        Raises:
            OutageError: The store takes nothing at present; the same group is sent again next time.
        """
        self._resize()
        group = self._next()
        if not group:
            return 0
        run = self._run(group[0][0])
        try:
            self._send(run, [event for event, _ in group])
        except RefusedError as error:
            if self._forget_lost(run):
                return self.step()
            self._reject(group[0][0], str(error))
        self.sent.offset = group[-1][1]
        self.sent.save(self.folder)
        return len(group)

    def _resize(self) -> None:
        """Begin anew where the journal is not the one that was sent."""
        if journal_size(self.folder) < self.sent.offset:
            self.sent.offset = 0

    def _next(self) -> list[tuple[Event, int]]:
        """Return the next events: all small ones up to a file, or one file."""
        if self.sent.run_id is None or self.sent.run_id != self.record.run_id:
            self.sent = Sent(rejected=self.sent.rejected)
        group: list[tuple[Event, int]] = []
        size = 0
        for event, offset in events(self.folder, self.sent.offset):
            if self.limit is not None and offset > self.limit:
                break
            if event["type"] not in BATCHES:
                return group or [(event, offset)]
            group.append((event, offset))
            size += len(event["values"])
            if size >= GROUP:
                break
        return group

    def _send(self, run: str, group: Sequence[Event]) -> None:
        kind = group[0]["type"]
        if kind in BATCHES:
            self._send_numbers(run, group)
        elif kind == "file":
            to = Path(group[0]["to"])
            self.ask(partial(_log_file, run, self._file(group[0]), to.parent.as_posix()))
            self.counts["files"] += 1
        elif kind == "picture":
            self._send_picture(run, group[0])
        elif kind == "model":
            self._send_model(run, group[0])
        elif kind == "status":
            self._send_status(run, group[0])

    def _send_numbers(self, run: str, group: Sequence[Event]) -> None:
        from mlflow.entities import Metric, Param, RunTag

        params: dict[str, Any] = {}
        tags: dict[str, Any] = {}
        metrics = []
        for event in group:
            if event["type"] == "metrics":
                metrics += [
                    Metric(k, float(v), event["t"], event["step"]) for k, v in event["values"].items()
                ]
            elif event["type"] == "params":
                params = {k: Param(k, _cut(v, "params")) for k, v in event["values"].items()} | params
            else:
                tags |= {k: RunTag(k, _cut(v, "tags")) for k, v in event["values"].items()}
        for kind, entries in (
            ("params", [*params.values()]),
            ("tags", [*tags.values()]),
            ("metrics", metrics),
        ):
            for start in range(0, len(entries), BATCHES[kind]):
                self._send_batch(run, kind, entries[start : start + BATCHES[kind]])
        self.counts["metrics"] += len(metrics)

    def _send_batch(self, run: str, kind: str, entries: list[Any]) -> None:
        """Send entries; those that the store refuses are found by halving and put aside."""
        try:
            self.ask(partial(_log_batch, run, {kind: entries}))
        except RefusedError as error:
            if self._lost(run):
                raise
            if kind == "params" and (new := self._new_params(run, entries)) is not None:
                if new:
                    self._send_batch(run, kind, new)
            elif len(entries) == 1:
                entry = entries[0]
                self._reject({"type": kind, "values": {entry.key: entry.value}}, str(error))
            else:
                middle = len(entries) // 2
                self._send_batch(run, kind, entries[:middle])
                self._send_batch(run, kind, entries[middle:])

    def _new_params(self, run: str, entries: list[Any]) -> list[Any] | None:
        """Return the parameters that the store does not have, None where it has none of them.

        Only a run that was begun before there was a journal can have others; they keep their first value.
        """
        known = self.ask(lambda client: client.get_run(run)).data.params
        if not any(entry.key in known for entry in entries):
            return None
        changed = {
            e.key: f"{known[e.key]} → {e.value}" for e in entries if known.get(e.key, e.value) != e.value
        }
        if changed:
            text = "; ".join(f"{key}: {value}" for key, value in changed.items())
            self.say(f"The run keeps the first values of changed parameters: {text}")
            self.ask(lambda client: client.set_tag(run, "params.changed", _cut(text, "tags")))
        return [entry for entry in entries if entry.key not in known]

    def _send_picture(self, run: str, event: Event) -> None:
        """Send a picture under the names by which the run's page finds the steps of a series.

        MLflow's `log_image` makes up a new name each time, so that one that is sent twice would appear twice.
        """
        import tempfile

        from mlflow.tracking.multimedia import compress_image_size
        from PIL import Image

        key = event["key"].replace("/", "~")
        name = f"{key}+step+{event['step']}+timestamp+{event['t']}+{event['sha256'][:32]}"
        try:
            picture = Image.open(self._file(event))
            picture.load()
        except OSError as error:  # it will not get better, and what is behind it must not wait
            raise RefusedError(f"{event['file']} cannot be read: {error}") from error
        with tempfile.TemporaryDirectory() as folder, picture:
            whole, small = Path(folder) / f"{name}.png", Path(folder) / f"{name}+compressed.webp"
            whole.symlink_to(self._file(event).resolve())
            compress_image_size(picture).save(small)
            for path in (whole, small):
                self.ask(partial(_log_file, run, path, "images"))
        self.ask(lambda client: client.set_tag(run, "mlflow.loggedImages", "True"))
        self.counts["files"] += 1

    def _send_model(self, run: str, event: Event) -> None:
        from trainer.export.register import log_and_register, registered_version

        name, weights = event["name"], event["weights"]
        version = self.ask(lambda client: registered_version(client, run, name, weights))
        if version is None:
            version = self.ask(lambda _: log_and_register(run, self._file(event), name, self.uri, weights))
            self.say(f"registered models:/{name}/{version}")

    def _send_status(self, run: str, event: Event) -> None:
        """Set the status; an evaluation ends only a run that was made for it."""
        status = event["status"]
        if event.get("evaluation") and not self.sent.created:
            return
        if status == "RUNNING":
            self.ask(lambda client: client.update_run(run, status=status))
        else:
            self.ask(lambda client: client.set_terminated(run, status, end_time=event["t"]))

    def _run(self, first: Event) -> str:
        """Return the run, which is made, or found again, on first use."""
        if self.record.run_id is None:
            try:
                self.record.run_id = self._made(first)
            except RefusedError as error:
                raise OutageError(Kind.AWAY, str(error)) from error
            self.record.save(self.folder)
            self.sent = Sent(self.record.run_id, created=True, rejected=self.sent.rejected)
            self.sent.save(self.folder)
        self.sent.run_id = self.record.run_id
        return self.record.run_id

    def _made(self, first: Event) -> str:
        identity = first.get("id", self.folder.name)
        experiment = self.ask(lambda client: experiment_id(client, self.uri, self.record.experiment))
        found = self.ask(lambda c: c.search_runs([experiment], f"tags.`{TAG}` = '{identity}'", max_results=1))
        if found:
            return str(found[0].info.run_id)
        tags = {TAG: identity, "penumbra.folder": str(self.folder)} | first.get("tags", {})
        run = self.ask(
            lambda client: client.create_run(experiment, first["t"], tags=tags, run_name=self.record.name)
        )
        return str(run.info.run_id)

    def _lost(self, run: str) -> bool:
        """Return whether the store has the run no longer."""
        try:
            found = self.ask(lambda client: client.get_run(run))
        except RefusedError:
            return True
        return bool(found.info.lifecycle_stage != "active")

    def _forget_lost(self, run: str) -> bool:
        """Prepare a new run that takes the place of one that was deleted; returns whether it was."""
        if not self._lost(run):
            return False
        self.say(
            f"The run {self.record.name} is no longer in {described(self.uri)}; a new one takes its place, "
            "with everything that was recorded."
        )
        self.record.run_id = None
        self.record.save(self.folder)
        return True

    def _reject(self, event: Event, why: str) -> None:
        """Put aside what the store will never take."""
        path = self.folder / SPOOL / "rejected.jsonl"
        with path.open("a") as file:
            file.write(json.dumps({"reason": why, "event": event}, ensure_ascii=False) + "\n")
        self.sent.rejected += 1
        what = ", ".join(event.get("values", {})) or event.get("to") or event.get("name") or event["type"]
        self.say(f"Refused by {described(self.uri)}: {what}: {why} (kept in {shown(path)})")

    def _file(self, event: Event) -> Path:
        """Return the copy of a file; one that is lost must not keep back what comes after it."""
        path = self.folder / SPOOL / str(event["file"])
        if not path.is_file():
            raise RefusedError(f"{path} is missing")
        return path

    def ask(self, action: Callable[[MlflowClient], T]) -> T:
        """Return the answer of the store.

        Raises:
            OutageError: It takes nothing at present.
            RefusedError: It will never take this.
        """
        try:
            if self._client is None:
                self._client = open_client(self.uri)
            return action(self._client)
        except (OutageError, RefusedError):
            raise
        except Exception as error:  # of MLflow, requests, SQLAlchemy, Alembic, boto3 …
            kind = classify(error)
            if kind is Kind.REFUSED:
                raise RefusedError(reason(error)) from error
            raise OutageError(kind, reason(error)) from error


def _log_batch(run: str, entries: dict[str, Any], client: MlflowClient) -> None:
    client.log_batch(run, **entries)


def _log_file(run: str, path: Path, folder: str, client: MlflowClient) -> None:
    client.log_artifact(run, str(path), None if folder == "." else folder)


def _cut(text: str, kind: str) -> str:
    limit = LIMITS[kind]
    return text if len(text) <= limit else text[: limit - 1] + "…"


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
