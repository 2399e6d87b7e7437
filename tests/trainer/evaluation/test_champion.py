import pandas as pd
import pytest

from trainer.evaluation.champion import Registered, champion_of, champions_beside, decide, move, registered
from trainer.evaluation.plan import Method, methods_of
from trainer.evaluation.tables import Scored
from trainer.spool.store import open_client

VERSIONS = [Registered("old", "wskp", "1"), Registered("new", "wskp", "2")]


def scored(old, new, metric="psnr_wskp"):
    """Scores of two versions in the scenes s, t, …"""
    rows = []
    for method, values in (("old", old), ("new", new)):
        for scene, value in zip("stuv", values, strict=False):
            name = f"{scene}/f000"
            row = {"method": method, "scene": scene, "name": name, "spp": 1, "reference": True, metric: value}
            rows.append(row)
    return Scored(pd.DataFrame(rows), ["old", "new"], [metric])


def test_a_version_that_is_better_and_nowhere_worse_becomes_the_champion():
    decision = decide(scored([20, 30], [22, 29.9]), VERSIONS, "1", "psnr_wskp", 0.01)
    assert decision.moves
    assert (decision.version, decision.before) == ("2", "1")


def test_a_better_average_is_not_enough_where_a_scene_gets_worse():
    decision = decide(scored([20, 30], [25, 29.5]), VERSIONS, "1", "psnr_wskp", 0.01)
    assert not decision.moves
    assert "worse in t: psnr_wskp 29.50, champion 30.00" in decision.text()
    assert decide(scored([20, 30], [25, 29.5]), VERSIONS, "1", "psnr_wskp", 0.02).moves


def test_errors_are_better_when_lower():
    assert decide(scored([0.2, 0.3], [0.1, 0.3], "flip_hdr"), VERSIONS, "1", "flip_hdr", 0.0).moves
    assert not decide(scored([0.2, 0.1], [0.1, 0.12], "flip_hdr"), VERSIONS, "1", "flip_hdr", 0.0).moves


def test_a_champion_that_is_equalled_stays():
    for one, other in (VERSIONS, VERSIONS[::-1]):
        decision = decide(scored([20, 30], [20, 30]), [one, other], "1", "psnr_wskp", 0.01)
        assert (decision.version, decision.moves) == ("1", False)


def test_a_scene_that_the_champion_lacks_is_told():
    decision = decide(scored([float("nan"), 30], [1, 31]), VERSIONS, "1", "psnr_wskp", 0.0)
    assert decision.moves
    assert "version 1 was, which has no value in s" in decision.text()


def test_the_first_champion_is_the_best_one():
    decision = decide(scored([20, 30], [25, 29.5]), VERSIONS, None, "psnr_wskp", 0.0)
    assert (decision.moves, decision.version) == (True, "2")


def test_a_version_without_a_result_for_every_frame_does_not_become_it():
    decision = decide(scored([20, 30], [40, float("nan")]), VERSIONS, "1", "psnr_wskp", 0.0)
    assert not decision.moves
    assert "stays" in decision.text()
    nothing = decide(scored([float("nan")] * 2, [float("nan")] * 2), VERSIONS, None, "psnr_wskp", 0.0)
    assert not nothing.moves


@pytest.fixture
def registry(tmp_path):
    """A store with two versions of a model, the first of which is the champion."""
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    client = open_client(uri)
    client.create_registered_model("wskp")
    for _ in range(2):
        client.create_model_version("wskp", str(tmp_path))
    client.set_registered_model_alias("wskp", "champion", "1")
    return uri


def test_the_champion_so_far_is_evaluated_too(registry):
    named = champions_beside(methods_of([("models:/wskp/2", ())]), registry)
    (champion,) = methods_of(named)
    assert (champion.label, champion.model) == ("wskp@champion", "models:/wskp/1")
    both = methods_of([("models:/wskp/2", ()), ("models:/wskp@champion", ())])
    assert champions_beside(both, registry) == []


def test_versions_are_found_by_number_alias_and_latest(registry):
    methods = [Method(m, f"models:/wskp{m}") for m in ("/2", "@champion", "/latest")]
    assert [entry.version for entry in registered(methods, registry)] == ["2", "1", "2"]


def test_the_alias_moves(registry):
    move(decide(scored([20], [21]), VERSIONS, champion_of("wskp", registry), "psnr_wskp", 0.0), registry)
    assert champion_of("wskp", registry) == "2"


def test_something_must_be_registered(registry):
    with pytest.raises(ValueError, match="models:/wskp/3"):
        champions_beside(methods_of([("NFOR", ())]), registry)
