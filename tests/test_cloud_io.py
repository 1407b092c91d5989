"""Cloud files: every format there and back, every damage named, nothing allocated on a header's
word."""

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.errors import CloudError, OutputError
from stereo_ore.io import clouds


def records(points: int = 7) -> clouds.Records:
    rng = np.random.default_rng(0)
    colours = {name: rng.integers(0, 256, points, np.uint8) for name in ("red", "green", "blue")}
    normals = {name: rng.normal(size=points).astype(np.float32) for name in ("nx", "ny", "nz")}
    return clouds.from_columns(
        {axis: rng.normal(size=points) for axis in "xyz"} | normals | colours
    )


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".csv", ".npy", ".npz"])
@pytest.mark.parametrize("points", [0, 1, 7])
def test_there_and_back_keeps_every_column(suffix: str, points: int, tmp_path: Path) -> None:
    path, wanted = tmp_path / f"cloud{suffix}", records(points)
    clouds.write(path, wanted)
    got = clouds.read(path)
    assert got.dtype.names == wanted.dtype.names
    if suffix == ".pcd":  # coordinates and normals have 4 bytes there
        wanted = wanted.astype(
            [
                (n, "f4" if kind == np.float64 else kind)
                for n, (kind, _) in wanted.dtype.fields.items()
            ]
        )
    for name in wanted.dtype.names or ():
        np.testing.assert_array_equal(got[name].astype(wanted.dtype[name]), wanted[name])
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".xyz", ".txt"])
def test_text_without_names_keeps_the_columns_in_order(suffix: str, tmp_path: Path) -> None:
    path, wanted = tmp_path / f"cloud{suffix}", records()
    clouds.write(path, wanted)
    got = clouds.read(path)
    assert got.dtype.names[:4] == ("x", "y", "z", "column_3")
    np.testing.assert_allclose(clouds.xyz(got), clouds.xyz(wanted))


@given(st.lists(st.tuples(*[st.floats(width=32, allow_nan=True)] * 3), max_size=20))
@settings(max_examples=30, deadline=None)
def test_any_floats_survive_ply(tmp_path_factory: pytest.TempPathFactory, rows: list) -> None:
    path = tmp_path_factory.mktemp("ply") / "cloud.ply"
    values = np.array(rows, np.float32).reshape(-1, 3)
    clouds.write(path, clouds.from_array(values, path))
    np.testing.assert_array_equal(clouds.xyz(clouds.read(path)), values)


def test_real_files(shared_data: Path) -> None:
    stone = clouds.read(shared_data / "stones" / "low_res_E34.ply")
    assert {"red", "nx"} <= set(stone.dtype.names)
    assert np.ptp(clouds.xyz(stone)[:, 0]) > 100
    assert len(clouds.read(shared_data / "stones" / "Otira_1cm_grains.ply")) == 100_769


@pytest.mark.parametrize(
    "text",
    ["1 2 3\n4 5 6\n", "1,2,3\n4,5,6\n", "1;2;3\n4;5;6\n", "x,y,z\n1,2,3\n4,5,6\n",
    "# by hand\n1\t2\t3\n\n4 5 6\n",
     "X Y Z\n1 2 3\n4 5 6", "z,y,x\n3,2,1\n6,5,4\n", "\ufeff1 2 3\n4 5 6\n"],
)  # fmt: skip
def test_text_layouts(text: str, tmp_path: Path) -> None:
    path = tmp_path / "cloud.csv"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(clouds.xyz(clouds.read(path)), [[1, 2, 3], [4, 5, 6]])


def test_ascii_and_big_endian_ply_with_an_element_before_the_vertices(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    head = "ply\nformat {} 1.0\nelement camera 1\nproperty float f\nelement vertex 2\n"
    head += "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(head.format("ascii") + "9\n1 2 3 255\n4 5 6 0\n3 0 1 1\n")
    ascii_ = clouds.read(path)
    body = (
        struct.pack(">f", 9) + struct.pack(">fffB", 1, 2, 3, 255) + struct.pack(">fffB", 4, 5, 6, 0)
    )
    path.write_bytes(head.format("binary_big_endian").encode() + body)
    for got in (ascii_, clouds.read(path)):
        np.testing.assert_array_equal(clouds.xyz(got), [[1, 2, 3], [4, 5, 6]])
        np.testing.assert_array_equal(got["red"], [255, 0])


def test_pcd_with_padding_and_vectors(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_text(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ h\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 1"
        " 2\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n1 2 3 0 7 8\n4 5 6 0 9 10\n"
    )
    got = clouds.read(path)
    np.testing.assert_array_equal(clouds.xyz(got), [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(got["h_1"], [8, 10])


PLY = "ply\nformat {format} 1.0\nelement vertex {count}\n"
PLY += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
PCD = (
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {count}\nDATA {data}\n"
)


def npy(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": dtype, "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


DAMAGED = {
    "huge.ply": (PLY.format(format="binary_little_endian", count=10**12).encode(), "claims"),
    "huge-ascii.ply": (PLY.format(format="ascii", count=10**12).encode() + b"1 2 3\n", "claims"),
    "short.ply": (PLY.format(format="ascii", count=3).encode() + b"1 2 3\n4 5 6             \n",
        "the header says 3"),
    "words.ply": (PLY.format(format="ascii", count=1).encode() + b"one two three\n", "not numbers"),
    "format.ply": (PLY.format(format="binary_middle", count=1).encode(), "is none of"),
    "nothing.ply": (b"", "does not begin"),
    "header.ply": (b"ply\nformat ascii 1.0\n", "no end_header"),
    "vertexless.ply": (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no vertex"),
    "count.ply": (PLY.format(format="ascii", count=-5).encode(), "not 'element NAME COUNT'"),
    "list.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int a\nend_header\n1 2\n",
        "list property",
    ),
    "flat.ply": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        "no column y"),
    "huge.pcd": (PCD.format(count=10**13, data="binary").encode(), "claims"),
    "huge-ascii.pcd": (PCD.format(count=10**13, data="ascii").encode(), "claims"),
    "packed.pcd": (PCD.format(count=1, data="binary_compressed").encode(), "claims"),
    "count.pcd": (PCD.format(count="many", data="ascii").encode(), "POINTS"),
    "not.pcd": (b"hello\n", "lacks FIELDS"),
    "type.pcd": (PCD.format(count=1, data="ascii").replace("F F F", "F F Q").encode(), "Q4"),
    "huge.npy": (npy((10**11, 3)), "claims"),
    "object.npy": (npy((1, 3), "|O"), "never loaded"),
    "flat.npy": (npy((3,)) + bytes(24), "shape"),
    "cut.npy": (npy((2, 3))[:20], "not a whole NP"),
    "not.npy": (b"hello", "not a whole NP"),
    "not.npz": (b"hello", "not a whole NPZ"),
    "words.csv": (b"1,2,3\n4,five,6\n", "not numbers"),
    "ragged.xyz": (b"1 2 3\n4 5\n", "not numbers"),
    "two.xyz": (b"1 2\n3 4\n", "shape"),
    "names.csv": (b"a,b,c\n1,2,3\n", "names with x, y, z"),
    "twice.csv": (b"x,y,z,x\n1,2,3,4\n", "twice"),
    "cloud.obj": (b"v 1 2 3\n", "no known cloud format"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_clear_errors_and_cost_no_memory(name: str, tmp_path: Path) -> None:
    content, words = DAMAGED[name]
    path = tmp_path / name
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(CloudError, match=words) as fault:
            clouds.read(path)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()
    assert name in str(fault.value)


def test_npz_that_unpacks_to_more_than_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stereo_ore.io.npz_io.MAX_UNPACKED_BYTES", 1000)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, xyz=np.zeros((1000, 3)))
    with pytest.raises(CloudError, match="claims arrays"):
        clouds.read(path)


@pytest.mark.parametrize(
    "arrays",
    [{"a": np.zeros(3)}, {"x": np.zeros(3), "y": np.zeros(2), "z": np.zeros(3)}, {}],
)
def test_npz_without_coordinates(arrays: dict, tmp_path: Path) -> None:
    path = tmp_path / "cloud.npz"
    np.savez(path, **arrays)
    with pytest.raises(CloudError):
        clouds.read(path)


def test_npz_with_a_broken_member(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xyz.npy", npy((10**10, 3)))
    with pytest.raises(CloudError, match="claims"):
        clouds.read(path)


def test_voxels_of_a_run_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "stages.npz"
    np.savez(
        path,
        voxel_xyz=np.ones((4, 3), np.float32),
        keep=np.ones(4, bool),
        disparity=np.zeros((5, 6)),
    )
    assert clouds.read(path).dtype.names == ("x", "y", "z", "keep")


def test_missing_file_and_unwritable_place(tmp_path: Path) -> None:
    with pytest.raises(CloudError, match="no such file"):
        clouds.read(tmp_path / "none.ply")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="can't be written"):
        clouds.write(tmp_path / "file" / "cloud.ply", records())
