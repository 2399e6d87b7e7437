import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from data.render import variant
from data.render.variant import Variant, candidates, choose, probe


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder of its own."""
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def compiled(folder: Path, body: str) -> str:
    """A shared library that runs `body` when it is loaded."""
    source = folder / "libLLVM-99.c"
    source.write_text(
        f"#include <stdlib.h>\n__attribute__((constructor)) static void start(void) {{ {body} }}"
    )
    library = folder / "libLLVM-99.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    return str(library)


def test_a_library_that_kills_its_process_is_rejected_and_the_caller_lives(cache, tmp_path):
    if subprocess.run(["which", "cc"], capture_output=True).returncode == 0:
        verdict = probe(compiled(tmp_path, "abort();"))
        assert verdict is not None
        assert "ended with" in verdict
    nothing = tmp_path / "libLLVM-98.so"
    nothing.write_bytes(b"no library at all")
    assert "ended with" in (probe(str(nothing)) or "")


def test_a_missing_library_is_rejected(cache, tmp_path):
    assert probe(str(tmp_path / "libLLVM-19.so")) == "no such file"


@pytest.mark.parametrize("version", [14, 15])
def test_old_versions_of_llvm_are_rejected_where_the_machine_has_them(cache, version):
    for library in Path("/usr/lib/x86_64-linux-gnu").glob(f"libLLVM-{version}.so.1"):
        assert probe(str(library)) is not None


def test_a_verdict_is_kept_until_the_file_changes(cache, tmp_path, monkeypatch):
    library = tmp_path / "libLLVM-77.so"
    library.write_bytes(b"x")
    tried = []
    monkeypatch.setattr(variant, "_try", lambda name: tried.append(name))
    assert probe(str(library)) is None
    assert probe(str(library)) is None
    assert len(tried) == 1
    library.write_bytes(b"xy")
    probe(str(library))
    assert len(tried) == 2
    assert [json.loads(f.read_text())["verdict"] for f in cache.iterdir()] == [None, None]


def test_a_broken_record_is_tried_again(cache, tmp_path, monkeypatch):
    library = tmp_path / "libLLVM-77.so"
    library.write_bytes(b"x")
    monkeypatch.setattr(variant, "_try", lambda _: "signal 6")
    assert probe(str(library)) == "signal 6"
    (record,) = cache.iterdir()
    record.write_text("{")
    monkeypatch.setattr(variant, "_try", lambda _: None)
    assert probe(str(library)) is None


def test_a_failure_of_the_moment_is_not_kept(cache, tmp_path, monkeypatch):
    library = tmp_path / "libLLVM-77.so"
    library.write_bytes(b"x")
    monkeypatch.setattr(variant, "_try", lambda _: "exit code 1 (OSError: disk full)")
    assert probe(str(library)) == "exit code 1 (OSError: disk full)"
    monkeypatch.setattr(variant, "_try", lambda _: None)
    assert probe(str(library)) is None


def test_the_library_of_the_environment_is_tried_first(monkeypatch, tmp_path):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "own.so"))
    assert candidates()[0] == str(tmp_path / "own.so")


def test_newer_libraries_are_tried_before_older_ones(monkeypatch, tmp_path):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    for name in ("libLLVM-16.so", "libLLVM.so.19.1", "libLLVM-18.so.1", "libLLVM-14.so", "libLLVM.so"):
        (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr(variant, "_FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(variant, "_known_to_the_linker", list)
    found = [Path(name).name for name in candidates()]
    assert found == ["libLLVM.so.19.1", "libLLVM-18.so.1", "libLLVM-16.so"]


def test_without_a_usable_library_the_scalar_variant_is_chosen_and_says_what_it_costs(monkeypatch):
    monkeypatch.setattr(variant, "candidates", lambda: ["/lib/libLLVM-15.so"])
    monkeypatch.setattr(variant, "probe", lambda _: "a small render ended with signal 6")
    chosen = choose()
    assert (chosen.name, chosen.library) == ("scalar_rgb", None)
    for part in ("times slower", "/lib/libLLVM-15.so: a small render ended with signal 6", "libllvm19"):
        assert part in chosen.reason
    with pytest.raises(ValueError, match="llvm_ad_rgb cannot be used: no LLVM library works"):
        choose("llvm_ad_rgb")
    monkeypatch.setattr(variant, "candidates", list)
    assert "no LLVM library was found" in choose().reason


def test_a_library_that_works_is_chosen(monkeypatch):
    monkeypatch.setattr(variant, "candidates", lambda: ["/a.so", "/b.so"])
    monkeypatch.setattr(variant, "probe", lambda name: "bad" if name == "/a.so" else None)
    assert choose() == Variant("llvm_ad_rgb", "/b.so", "llvm_ad_rgb with /b.so")


def test_an_unknown_variant_is_refused():
    with pytest.raises(ValueError, match="unknown Mitsuba variant 'cuda'"):
        choose("cuda")


def test_without_mitsuba_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install penumbra-denoise\[render\]"):
        choose()
    with pytest.raises(ValueError, match=r"pip install penumbra-denoise\[render\]"):
        variant.activate(Variant("scalar_rgb", None, ""))


def test_choosing_does_not_load_the_renderer():
    code = "import sys, data.render.variant, data.render.tracer; print('mitsuba' in sys.modules)"
    root = Path(__file__).parents[3]
    child = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=dict(os.environ), capture_output=True, text=True
    )
    assert child.stdout.strip() == "False"
