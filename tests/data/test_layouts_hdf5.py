import subprocess
import sys
import textwrap
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from data.layouts.hdf5 import dataset, items, names, open_hdf5

GOOD = np.random.default_rng(0).random((6, 8, 8, 3)).astype(np.float32)


def file_with(path, fill):
    with h5py.File(path, "w") as file:
        fill(file)
    return path


def good(file):
    file.create_dataset("x", data=GOOD, compression="gzip", shuffle=True, chunks=(2, 8, 8, 3))


def refused(path, message, ndim=4):
    with open_hdf5(path) as file, pytest.raises(ValueError, match=rf"a\.h5: data set 'x'.* {message}"):
        dataset(file, "x", ndim, 3)


@pytest.mark.parametrize("options", [{}, {"compression": "gzip"}, {"compression": "lzf", "shuffle": True}])
def test_numbers_are_read_in_slices_as_float32(tmp_path, options):
    path = file_with(tmp_path / "a.h5", lambda f: f.create_dataset("x", data=GOOD.astype("f2"), **options))
    with open_hdf5(path) as file:
        source = dataset(file, "x", 4, 3)
        assert np.array_equal(items(source, 2), GOOD.astype("f2")[2])
        part = items(source, 1, 4)
        assert part.dtype == np.float32
        assert np.array_equal(part, GOOD.astype("f2")[1:4])
        with pytest.raises(ValueError, match="has 6 items, asked for 6 to 6"):
            items(source, 6)


def external_file(file):
    file["x"] = h5py.ExternalLink("/etc/passwd", "/x")


def soft_link(file):
    good(file)
    file.move("x", "y")
    file["x"] = h5py.SoftLink("/y")


def elsewhere(file):
    file.create_dataset("x", GOOD.shape, "f4", external=[("/etc/hostname", 0, h5py.h5f.UNLIMITED)])


def virtual(file):
    layout = h5py.VirtualLayout(GOOD.shape, "f4")
    layout[...] = h5py.VirtualSource("/etc/passwd", "x", GOOD.shape)
    file.create_virtual_dataset("x", layout)


def huge(file):
    file.create_dataset("x", (10**9, 128, 128, 3), "f4", chunks=(1, 128, 128, 3), compression="gzip")


def huge_item(file):
    file.create_dataset("x", (2, 10**6, 10**6, 3), "f4", chunks=(1, 100, 100, 3), compression="gzip")


def huge_chunk(file):
    shape = (500, 512, 512, 3)
    file.create_dataset("x", shape, "f4", chunks=shape, compression="gzip")


def strings(file):
    file.create_dataset("x", (2, 2, 2, 3), h5py.string_dtype())


def compound(file):
    file.create_dataset("x", (2, 2, 2, 3), np.dtype([("r", "f4"), ("o", h5py.ref_dtype)]))


HOSTILE = {
    external_file: "is a link to another file",
    soft_link: "is a soft link",
    elsewhere: "is stored in another file",
    virtual: "is virtual",
    huge: r"claims the shape \(1000000000, 128, 128, 3\), .* but holds only 0",
    huge_item: "needs .* MiB per item, refused",
    huge_chunk: "chunks of .* need .* MiB each, refused",
    strings: "holds object, expected numbers",
    compound: r"holds \[.*expected numbers",
    lambda f: f.create_group("x"): "is a group, expected a data set",
    lambda f: f.create_dataset("y", data=1): "is missing; the file has y",
    lambda f: f.create_dataset("x", data=GOOD[0]): r"has the shape \(8, 8, 3\), expected 4 axes",
    lambda f: f.create_dataset("x", data=GOOD[:0]): r"has the shape \(0, 8, 8, 3\)",
    lambda f: f.create_dataset("x", dtype="f4", shape=None, data=h5py.Empty("f4")): "has the shape None",
    lambda f: f.create_dataset("x", data=GOOD[..., :2]): "has 2 channels on its last axis, expected 3",
    lambda f: f.create_dataset("x", data=GOOD > 0, scaleoffset=None): "holds bool, expected numbers",
    lambda f: f.create_dataset("x", data=(GOOD * 9).astype("i4"), scaleoffset=4): "compressed with filter 6",
}


@pytest.mark.parametrize("fill", HOSTILE, ids=HOSTILE.values())
def test_data_sets_that_are_unsafe_or_no_numbers_are_refused(tmp_path, fill):
    refused(file_with(tmp_path / "a.h5", fill), HOSTILE[fill])


def test_a_chunk_that_inflates_beyond_its_size_is_refused(tmp_path):
    def bomb(file):
        made = file.create_dataset("x", (2, 8, 8, 3), "f4", chunks=(1, 8, 8, 3), compression="gzip")
        packed = zlib.compress(np.random.default_rng(0).bytes(1_200_000) + bytes(1 << 24))
        made.id.write_direct_chunk((0, 0, 0, 0), packed)
        made[1] = GOOD[1]

    with open_hdf5(file_with(tmp_path / "a.h5", bomb)) as file:
        source = dataset(file, "x", 4, 3)
        assert np.array_equal(items(source, 1), GOOD[1])
        with pytest.raises(ValueError, match=r"chunk at \(0, 0, 0, 0\) holds more than 768 bytes, refused"):
            items(source, 0)


def test_large_chunks_are_read(tmp_path):
    big = np.random.default_rng(1).random((5, 256, 256, 3)).astype(np.float32)
    options = {"chunks": (2, 256, 256, 3), "compression": "gzip", "shuffle": True, "fletcher32": True}
    with open_hdf5(
        file_with(tmp_path / "a.h5", lambda f: f.create_dataset("x", data=big, **options))
    ) as file:
        assert np.array_equal(items(dataset(file, "x", 4, 3), 1, 5), big[1:])


@pytest.mark.parametrize("name", ["a/x", "/x", "../x", ".", ".."])
def test_names_with_path_separators_are_refused(tmp_path, name):
    path = file_with(tmp_path / "a.h5", lambda f: f.create_dataset("a/x", data=GOOD))
    with open_hdf5(path) as file, pytest.raises(ValueError, match="a name at the top level"):
        dataset(file, name, 4)


def test_data_damaged_inside_a_chunk_are_named(tmp_path):
    path = file_with(tmp_path / "a.h5", good)
    with h5py.File(path) as file:
        offset = file["x"].id.get_chunk_info(1).byte_offset
    content = bytearray(path.read_bytes())
    content[offset : offset + 200] = bytes(200)
    path.write_bytes(content)
    with open_hdf5(path) as file:
        source = dataset(file, "x", 4, 3)
        assert np.array_equal(items(source, 0), GOOD[0])
        with pytest.raises(ValueError, match=r"a\.h5: data set 'x', items 2 to 2: damaged"):
            items(source, 2)


@pytest.mark.parametrize("fraction", [0.01, 0.3, 0.9])
def test_truncated_files_are_named(tmp_path, fraction):
    path = file_with(tmp_path / "a.h5", good)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * fraction)])
    with pytest.raises(ValueError, match=r"a\.h5: damaged or truncated HDF5 file"):
        open_hdf5(path)


def test_files_of_another_kind_are_named(tmp_path):
    (tmp_path / "a.h5").write_bytes(b"PK\x03\x04 a zip")
    (tmp_path / "b.h5").write_bytes(b"")
    for name, message in (("a.h5", "not an HDF5 file"), ("b.h5", "the file is empty")):
        with pytest.raises(ValueError, match=rf"{name}: {message}"):
            open_hdf5(tmp_path / name)
    with pytest.raises(ValueError, match="is a folder"):
        open_hdf5(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_hdf5(tmp_path / "none.h5")


def test_names_are_listed_without_following_links(tmp_path):
    with open_hdf5(file_with(tmp_path / "a.h5", external_file)) as file:
        assert names(file) == ["x"]


def test_a_shape_that_the_file_does_not_hold_takes_no_memory(tmp_path):
    path = file_with(tmp_path / "a.h5", huge)
    script = textwrap.dedent(f"""
        import resource
        from data.layouts.hdf5 import dataset, open_hdf5
        open_hdf5({str(path)!r}).close()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with open_hdf5({str(path)!r}) as file:
            try:
                dataset(file, "x", 4, 3)
            except ValueError:
                print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    """)
    root = Path(__file__).parents[2]
    result = subprocess.run(
        [sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=True
    )
    assert int(result.stdout) < 20_000


def test_without_h5py_the_message_says_how_to_install_it(tmp_path, monkeypatch):
    path = file_with(tmp_path / "a.h5", good)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(
        ValueError, match=r"h5py, which is not installed: pip install penumbra-denoise\[layouts\]"
    ):
        open_hdf5(path)
