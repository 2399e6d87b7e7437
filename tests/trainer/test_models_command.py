"""`trainer models`: the catalogue and the registered versions."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

import models
from models import NFOR, WSKP
from trainer.commands import models as command
from trainer.options import options_of


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> str:
    monkeypatch.setenv("COLUMNS", "220")
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    assert command.run(parser.parse_args(arguments)) == 0
    return capsys.readouterr().out


def test_every_denoiser_is_listed_with_inputs_parameters_and_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    text = run(capsys, monkeypatch)
    assert all(f"models.{name}" in text for name in models.__all__)
    assert "38,220" in text
    assert "27,300" in text
    assert "irradiance, albedo, normal, depth" in text
    assert "doi:10.1111/cgf.14338" in text
    assert "No registered models: no model store" in text
    assert list(tmp_path.iterdir()) == []


def test_registered_versions_are_listed_with_their_aliases(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mlflow.tracking import MlflowClient

    uri = f"sqlite:///{tmp_path}/mlflow.db"
    client = MlflowClient(uri, uri)
    client.create_registered_model("wskp")
    for _ in range(2):
        client.create_model_version("wskp", source=str(tmp_path))
    client.set_registered_model_alias("wskp", "champion", "2")
    text = run(capsys, monkeypatch, "--tracking-uri", uri)
    rows = [line for line in text.splitlines() if "models:/wskp/" in line]
    assert len(rows) == 2
    assert "@champion" not in rows[0]
    assert "@champion" in rows[1]


def test_the_reference_is_the_paragraph_with_the_doi() -> None:
    assert command.reference(WSKP).startswith("Hangming Fan")


def test_the_options_of_a_method_are_listed_with_defaults_types_and_meaning(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run(capsys, monkeypatch, "CrossBilateral")
    assert "  radius=6   (a whole number)\n      Half the window." in out
    assert "trainer denoise --model CrossBilateral --option OPTION=VALUE" in out
    assert "models.WSKP" not in out
    out = run(capsys, monkeypatch, "NFOR")
    assert "preset=public   (public or paper)" in out
    assert "features=normal,albedo,depth   (words with commas between)" in out
    for option in options_of(NFOR).values():
        assert option.meaning, option.name


def test_an_unknown_denoiser_is_named_with_the_nearest(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FileNotFoundError, match=r"NFR: no such denoiser; did you mean NFOR\?"):
        run(capsys, monkeypatch, "NFR")
    with pytest.raises(FileNotFoundError, match=r"jointnlm: no such denoiser; did you mean JointNLM\?"):
        run(capsys, monkeypatch, "jointnlm")
