import pytest

from trainer.evaluation.plan import clips_of, methods_of


def labels(*models):
    return [method.label for method in methods_of([(model, ()) for model in models])]


def test_a_method_is_called_by_its_model_and_options():
    assert labels("NFOR", "models:/wskp/3", "models:/wskp@champion", "runs:/ab12/model") == [
        "NFOR", "wskp/3", "wskp@champion", "ab12/model",
    ]  # fmt: skip
    assert labels("runs/wskp_bmfr/calm-otter/checkpoints/best.ckpt", "out/wskp.onnx", "runs/wskp/x") == [
        "calm-otter", "wskp", "x",
    ]  # fmt: skip
    (method,) = methods_of([("NFOR", ["preset=paper", "frames=2"])])
    assert (method.label, method.options) == ("NFOR preset=paper frames=2", ("preset=paper", "frames=2"))


def test_a_label_may_be_given():
    (method,) = methods_of([("ours=models:/wskp/3", ())])
    assert (method.label, method.model) == ("ours", "models:/wskp/3")


def test_equal_names_are_told_apart_and_folders_are_safe():
    found = methods_of([("a/wskp.onnx", ()), ("b/wskp.onnx", ()), ("Ours ±=NLM", ()), ("ours=NFOR", ())])
    assert [method.label for method in found] == ["wskp", "wskp (2)", "Ours ±", "ours"]
    folders = [method.folder for method in found]
    assert len({folder.lower() for folder in folders}) == 4
    assert all(folder.replace("-", "").replace(".", "").isalnum() for folder in folders)


def test_a_folder_follows_from_its_label_alone():
    """Results of an earlier command must not appear under the name of another method."""
    labels = ["ours+", "ours", "Метод", "Сеть", "a b", "a-b", "x" * 70, "x" * 71, "Input", "..", "-"]
    one = {m.label: m.folder for m in methods_of([(f"{label}=NLM", ()) for label in labels])}
    other = {m.label: m.folder for m in methods_of([(f"{label}=NLM", ()) for label in reversed(labels)])}
    assert one == other
    assert len({folder.lower() for folder in one.values()} | {"input", "reference"}) == len(labels) + 2
    assert one["ours"] == "ours"
    assert one["a-b"] == "a-b"


def test_an_existing_file_is_no_label(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "epoch=3-step=100.ckpt").write_bytes(b"")
    (method,) = methods_of([("epoch=3-step=100.ckpt", ())])
    assert method.model == "epoch=3-step=100.ckpt"


@pytest.mark.parametrize("label", ["input", "reference"])
def test_names_of_other_columns_are_refused(label):
    with pytest.raises(ValueError, match=label):
        methods_of([(f"{label}=NLM", ())])
    with pytest.raises(ValueError, match="ours"):
        methods_of([("ours=NLM", ()), ("ours=NFOR", ())])


def test_the_test_scenes_are_taken_where_there_are_any():
    clips, split = clips_of("sample:bmfr", "auto")
    assert (split, {item.name.split("/")[0] for clip in clips for item in clip.items}) == (
        "test",
        {"classroom"},
    )
    everything, split = clips_of("sample:bmfr", "all")
    assert split is None
    assert len(everything) == 3
