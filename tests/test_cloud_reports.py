"""Cloud files of real tools and real people: each kind with its right value, and what other
programs make of ours."""

import logging
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.cli.filter import filter_
from stereo_ore.errors import CloudError
from stereo_ore.io import clouds
from stereo_ore.io.clouds.lzf import decompress
from stereo_ore.io.clouds.records import from_array, upright

FIRST = (0.07506, 0.08474, 1.23206)
COLOURS = [[10, 20, 30], [200, 20, 30], [10, 220, 30]]


def filtered(source: Path, out: Path) -> clouds.Records:
    """What ``filter … --method none`` writes, read again."""
    filter_(source, out, method="none")
    return clouds.read(out)


def colours(records: clouds.Records) -> list:
    assert all(records.dtype[name] == np.uint8 for name in ("red", "green", "blue"))
    return np.stack([records[name] for name in ("red", "green", "blue")], -1).tolist()


def header(path: Path) -> dict[str, str]:
    lines = path.read_bytes().split(b"DATA")[0].decode().splitlines()
    return {line.split()[0]: " ".join(line.split()[1:]) for line in lines if line}


ROWS = {
    "qnan.ply": 499, "ind.ply": 499, "ind2.ply": 499, "nan.ply": 499, "nanq.ply": 499,
    "inf.ply": 499,
    "pcd_ascii_nan.pcd": 499, "win.xyz": 499, "normals.ply": 500, "upper.ply": 500,
    "rangegrid.ply": 500,
    "paraview.csv": 500, "units.csv": 500, "trailing_comma.csv": 500,
    "trailing_comma_nohead.csv": 500,
    "decimal_comma.csv": 500, "decimal_comma.txt": 500, "utf16.csv": 500, "pts_count.txt": 500,
    "conf.xyz": 300,
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_15_ascii_nan(name: str, shared_data: Path) -> None:
    xyz = clouds.xyz(clouds.read(shared_data / "reports/15-ascii-nan" / name))
    finite = np.isfinite(xyz).all(1)
    assert finite.sum() == ROWS[name]
    np.testing.assert_allclose(xyz[0], (-0.259768, -0.058355, 0.837076), atol=1e-7)
    assert np.abs(xyz[finite]).max() < 2, "no 1.#QNAN has become 1.0"


@pytest.mark.parametrize("name", ["z_qnan", "z_ind", "z_nan", "z_inf"])
@pytest.mark.parametrize("suffix", [".ply", ".xyz"])
def test_15_ascii_nan_in_one_coordinate(name: str, suffix: str, shared_data: Path) -> None:
    z = clouds.read(shared_data / "reports/15-ascii-nan" / (name + suffix))["z"]
    plain = clouds.read(shared_data / f"reports/15-ascii-nan/z_nan{suffix}")["z"]
    np.testing.assert_array_equal(np.isfinite(z), np.isfinite(plain))
    assert (~np.isfinite(z)).sum() > 5


@pytest.mark.parametrize(
    "name", ["plain", "blank_first", "blank_between", "header_blank", "double_space", "two_lines",
    "realsense_lines",
             "comma", "comment_body", "cr_only", "no_newline_end"]
)  # fmt: skip
def test_29_ply_blank_lines(name: str, shared_data: Path) -> None:
    folder = shared_data / "reports/29-ply-blank-lines"
    xyz, plain = (clouds.xyz(clouds.read(folder / f"{n}.ply")) for n in (name, "plain"))
    np.testing.assert_array_equal(xyz, plain)
    assert len(xyz) == 300


@pytest.mark.parametrize("name", ["blank.pcd", "v5.pcd"])
def test_29_pcd(name: str, shared_data: Path) -> None:
    assert len(clouds.read(shared_data / "reports/29-ply-blank-lines" / name)) == 300


def test_14_pcd_viewpoint(
    shared_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = shared_data / "reports/14-pcd-viewpoint"
    filtered(folder / "tilted.pcd", tmp_path / "out.pcd")
    assert (
        header(tmp_path / "out.pcd")["VIEWPOINT"]
        == "-55.6948 -43.715 -35.9986 0.7071068 0.7071068 0 0"
    )
    with caplog.at_level(logging.WARNING, "stereo_ore"):
        clouds.write(
            tmp_path / "out.ply",
            clouds.read(folder / "tilted.pcd"),
            clouds.viewpoint(folder / "tilted.pcd"),
        )
    assert "viewpoint" in caplog.text
    wanted = np.load(folder / "colours.npy")
    packed = clouds.read(folder / "organised_rgb.pcd")
    bits = sum(
        packed[name].astype(np.uint32) << shift
        for name, shift in (("red", 16), ("green", 8), ("blue", 0))
    )
    np.testing.assert_array_equal(bits, wanted & 0xFFFFFF)
    again = filtered(folder / "organised_rgb.pcd", tmp_path / "out.csv")
    finite = np.isfinite(clouds.xyz(packed)).all(
        1
    )  # the filter drops the others, whatever the method
    np.testing.assert_array_equal(colours(again), colours(packed[finite]))


def test_05_cloud_columns(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "reports2/05-cloud-columns"
    for name in ("time_first.txt", "named.csv", "slashes.txt"):
        assert clouds.xyz(clouds.read(folder / name))[0].tolist() == list(FIRST)
    assert clouds.read(folder / "time_first.txt").dtype.names == ("t", "x", "y", "z", "intensity")
    filtered(folder / "named.csv", tmp_path / "o.xyz")
    assert (tmp_path / "o.xyz").read_text().splitlines()[0].split()[3] == "154"
    ply = filtered(folder / "slashes.txt", tmp_path / "o.ply")
    assert colours(ply)[0] == [119, 99, 207]
    assert ply["Intensity"][0] == 154


def test_06_cloud_3xn(shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(shared_data / "reports2/06-cloud-3xn/three_rows.npy", tmp_path / "o.csv")
    assert len(cloud) == 300
    np.testing.assert_allclose(clouds.xyz(cloud)[0], FIRST, atol=1e-7)
    assert upright(np.eye(3), tmp_path).shape == (3, 3)
    with pytest.raises(CloudError, match=r"3 points of 6 values, or 6 points of 3"):
        upright(np.zeros((3, 6)), tmp_path)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_07_cloud_names(suffix: str, shared_data: Path, tmp_path: Path) -> None:
    for name, column in (("umlaut", "H_he"), ("blanks", "Scan_Angle_Rank")):
        cloud = filtered(
            shared_data / f"reports2/07-cloud-names/{name}.csv", tmp_path / f"{name}{suffix}"
        )
        assert len(cloud) == 300
        assert cloud[column][0] == 154


def test_names_made_fit_stay_distinct(tmp_path: Path) -> None:
    names = ("x", "y", "z", "a b", "a_b", "é", "ü", "_")
    records = clouds.from_columns({name: np.full(2, float(i)) for i, name in enumerate(names)})
    for suffix in (".ply", ".pcd"):
        clouds.write(tmp_path / f"c{suffix}", records)
        read = clouds.read(tmp_path / f"c{suffix}")
        assert len(read.dtype.names) == len(names)
        assert [read[name][0] for name in read.dtype.names] == list(range(8))


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".npz", ".pcd"])
def test_08_cloud_int64(suffix: str, shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(shared_data / "reports2/08-cloud-int64/ns.csv", tmp_path / f"o{suffix}")
    assert cloud["timestamp"][0] == 1712345678901234567
    assert cloud["timestamp"].dtype == np.int64
    if suffix == ".csv":
        assert (tmp_path / "o.csv").read_text().splitlines()[1].endswith(",1712345678901234567")


def test_08_cloud_int64_in_ply_is_said(
    shared_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "stereo_ore"):
        clouds.write(
            tmp_path / "o.ply", clouds.read(shared_data / "reports2/08-cloud-int64/ns.csv")
        )
    assert "64 bits" in caplog.text


def test_clouds_01_csv_to_pcd(shared_data: Path, tmp_path: Path) -> None:
    import open3d

    filtered(shared_data / "surprises/clouds-01-csv-to-pcd/scan.csv", tmp_path / "out.pcd")
    assert header(tmp_path / "out.pcd")["SIZE"] == "4 4 4"
    seen = np.asarray(open3d.io.read_point_cloud(str(tmp_path / "out.pcd")).points)
    np.testing.assert_allclose(
        seen, [[0.5, 0.25, 1], [0.6, 0.25, 1], [0.5, 0.35, 1.01], [0.6, 0.35, 1.02]], atol=1e-7
    )


def test_a_far_origin_is_no_pcd(tmp_path: Path) -> None:
    cloud = from_array(
        np.array([[500000.12, 4649776.22, 100.0], [500001.12, 4649777.22, 101.0]]), tmp_path
    )
    with pytest.raises(CloudError, match=r"out\.pcd.*would move points.*Write PLY"):
        clouds.write(tmp_path / "out.pcd", cloud)
    assert not list(tmp_path.iterdir())
    clouds.write(
        tmp_path / "mm.pcd", from_array(np.array([[5000.123, 0.5, 1.0], [0.1, 0.2, 0.3]]), tmp_path)
    )


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_clouds_02_column_name_with_a_blank(suffix: str, shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(
        shared_data / "surprises/clouds-02-column-name-with-a-blank/scan.csv",
        tmp_path / f"out{suffix}",
    )
    assert cloud["Scalar_field"].tolist() == [5, 6, 7]
    assert colours(cloud)[0] == [10, 20, 30]


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_clouds_03_column_name_not_ascii(suffix: str, shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(
        shared_data / "surprises/clouds-03-column-name-not-ascii/scan.csv",
        tmp_path / f"out{suffix}",
    )
    assert cloud["H_he"].tolist() == [5, 6, 7]


def test_clouds_04_colours_csv_to_ply(shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(
        shared_data / "surprises/clouds-04-colours-csv-to-ply/scan.csv", tmp_path / "out.ply"
    )
    assert colours(cloud) == COLOURS
    assert (cloud["ore_id"].dtype, cloud["ore_id"].tolist()) == (np.int32, [1, 1, 2])
    assert b"property uchar red" in (tmp_path / "out.ply").read_bytes()


@pytest.mark.parametrize("kind", ["clouds-05-packed-rgb-to-ply", "clouds-07-pcd-binary-compressed"])
@pytest.mark.parametrize("suffix", [".ply", ".csv", ".npz", ".pcd"])
def test_packed_colours_become_columns(
    kind: str, suffix: str, shared_data: Path, tmp_path: Path
) -> None:
    cloud = filtered(shared_data / "surprises" / kind / "scan.pcd", tmp_path / f"out{suffix}")
    assert colours(cloud) == COLOURS
    np.testing.assert_allclose(
        clouds.xyz(cloud), [[0.5, 0.25, 1], [0.6, 0.25, 1], [0.5, 0.35, 1.01]], atol=1e-7
    )


def test_clouds_06_colours_to_pcd(shared_data: Path, tmp_path: Path) -> None:
    import open3d

    cloud = filtered(
        shared_data / "surprises/clouds-06-colours-to-pcd/scan.ply", tmp_path / "out.pcd"
    )
    assert header(tmp_path / "out.pcd")["FIELDS"] == "x y z rgb ore_id"
    assert cloud["ore_id"].tolist() == [1, 1, 2]
    seen = open3d.io.read_point_cloud(str(tmp_path / "out.pcd"))
    assert seen.has_colors()
    np.testing.assert_allclose(np.asarray(seen.colors) * 255, COLOURS, atol=1e-4)


@pytest.mark.parametrize(
    "file", ["clouds-08-cloudcompare-text/scan.txt", "clouds-08-cloudcompare-text/scan.asc",
             "clouds-09-cloudcompare-point-count/scan.txt"]
)  # fmt: skip
def test_clouds_08_and_09_cloudcompare_text(file: str, shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(shared_data / "surprises" / file, tmp_path / "out.csv")
    assert cloud.dtype.names == (
        "x",
        "y",
        "z",
        "red",
        "green",
        "blue",
        "Scalar_field",
        "Scalar_field_#2",
    )
    assert len(cloud) == 5
    assert colours(cloud)[0] == [110, 239, 86]


def test_clouds_10_float16_to_pcd(shared_data: Path, tmp_path: Path) -> None:
    cloud = filtered(
        shared_data / "surprises/clouds-10-float16-to-pcd/scan.npy", tmp_path / "out.pcd"
    )
    assert header(tmp_path / "out.pcd")["SIZE"] == "4 4 4"
    np.testing.assert_allclose(clouds.xyz(cloud), [[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]], atol=1e-4)


def test_clouds_11_surface_with_thickness(shared_data: Path, tmp_path: Path) -> None:
    scan = shared_data / "surprises/clouds-11-surface-with-thickness/scan.npy"
    line = ["stereo-ore", "filter", str(scan), str(tmp_path / "out.npy")]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    assert len(np.load(tmp_path / "out.npy")) > 6000 or "Thin it" in " ".join(done.stderr.split())


def test_clouds_12_viewpoint(shared_data: Path, tmp_path: Path) -> None:
    filtered(shared_data / "surprises/clouds-12-viewpoint/scan.pcd", tmp_path / "out.pcd")
    assert header(tmp_path / "out.pcd")["VIEWPOINT"] == "0 0 -1.5 0.7071068 0.7071068 0 0"


def test_ply_pcd_csv_ply_keeps_colours_and_types(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 200
    columns = {axis: rng.normal(size=n).astype(np.float32) for axis in "xyz"}
    columns |= {name: rng.integers(0, 256, n).astype(np.uint8) for name in ("red", "green", "blue")}
    columns |= {
        "ore_id": rng.integers(0, 9, n).astype(np.int32),
        "score": rng.normal(size=n).astype(np.float32),
    }
    first = clouds.from_columns(columns)
    clouds.write(tmp_path / "a.ply", first)
    for old, new in (("a.ply", "b.pcd"), ("b.pcd", "c.csv"), ("c.csv", "d.ply")):
        clouds.write(tmp_path / new, clouds.read(tmp_path / old))
    last = clouds.read(tmp_path / "d.ply")
    assert last.dtype == first.dtype
    np.testing.assert_array_equal(last, first)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "d.ply").read_bytes()


def test_what_open3d_reads_of_what_we_write(tmp_path: Path) -> None:
    import open3d

    rng = np.random.default_rng(1)
    columns = {axis: rng.normal(size=50) for axis in "xyz"}
    columns |= {name: rng.normal(size=50) for name in ("nx", "ny", "nz")}
    columns |= {
        name: rng.integers(0, 256, 50).astype(np.uint8) for name in ("red", "green", "blue")
    }
    columns |= {"ore_id": rng.integers(0, 9, 50), "Höhe über NN": rng.normal(size=50)}
    records = clouds.from_columns(columns)
    for suffix in (".ply", ".pcd"):
        clouds.write(tmp_path / f"c{suffix}", records)
        seen = open3d.io.read_point_cloud(str(tmp_path / f"c{suffix}"))
        np.testing.assert_allclose(np.asarray(seen.points), clouds.xyz(records), atol=1e-6)
        np.testing.assert_allclose(np.asarray(seen.colors) * 255, colours(records), atol=1e-3)
    clouds.write(tmp_path / "c.xyz", clouds.from_columns({axis: columns[axis] for axis in "xyz"}))
    seen = open3d.io.read_point_cloud(str(tmp_path / "c.xyz"))
    np.testing.assert_allclose(np.asarray(seen.points), clouds.xyz(records), atol=1e-12)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_there_and_back(suffix: str, tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    rng = np.random.default_rng(2)
    columns = {
        axis: rng.normal(size=40) + shift
        for axis, shift in zip("xyz", (500_000, 4_649_776, 100), strict=True)
    }
    columns |= {
        name: rng.integers(0, 256, 40).astype(np.uint8) for name in ("red", "green", "blue")
    }
    columns |= {
        "ore_id": rng.integers(0, 9, 40).astype(np.int32),
        "score": rng.normal(size=40).astype(np.float32),
    }
    records = clouds.from_columns(columns)
    path = tmp_path / f"cloud{suffix}"
    clouds.write(path, records)
    read = clouds.read(path)
    np.testing.assert_allclose(clouds.xyz(read), clouds.xyz(records), atol=6e-6)
    assert colours(read) == colours(records)
    np.testing.assert_array_equal(read["ore_id"], records["ore_id"])
    np.testing.assert_array_equal(read["score"], records["score"])
    assert len(laspy.read(path)) == 40
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(CloudError):
        clouds.read(path)


def test_either_count_of_a_las_header_is_held_against_the_file(tmp_path: Path) -> None:
    """The old one of 32 bits and the one of LAS 1.4: the version says which of them counts."""
    pytest.importorskip("laspy")
    path = tmp_path / "cloud.las"
    clouds.write(path, clouds.from_columns({axis: np.arange(5.0) for axis in "xyz"}))
    whole = path.read_bytes()
    for offset, kind in ((107, "<I"), (247, "<Q")):
        damaged = bytearray(whole)
        struct.pack_into(kind, damaged, offset, 10**9)
        path.write_bytes(damaged)
        with pytest.raises(CloudError, match="claims points"):
            clouds.read(path)


@pytest.mark.parametrize("suffix", list(clouds.CLOUD_FORMATS))
def test_an_odd_column_is_kept_or_told(
    suffix: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of every type and name, through every format: read again with its values, or a line that
    names it."""
    if suffix in (".las", ".laz"):
        pytest.importorskip("laspy")
    rng = np.random.default_rng(3)
    for kind in ("?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8"):
        for name in ("odd", "a b", "ö", "Red", "_", "t", "rgb", "point:7"):
            odd = (100 * rng.random(6)).astype(kind)
            columns = {"x": np.arange(6.0), name: odd, "y": np.arange(6.0), "z": np.ones(6)}
            path = tmp_path / f"c{suffix}"
            caplog.clear()
            with caplog.at_level(logging.INFO, "stereo_ore"):
                clouds.write(path, clouds.from_columns(columns))
                read = clouds.read(path)
            np.testing.assert_allclose(clouds.xyz(read)[:, 0], range(6), atol=1e-12)
            values = [read[column] for column in read.dtype.names if column not in ("x", "y", "z")]
            kept = len(values) == 1 and np.allclose(
                values[0].astype(float), odd.astype(float), rtol=1e-6
            )
            assert kept or len(values) == 3 or "left out" in caplog.text, (kind, name, read.dtype)


def test_columns_of_several_numbers_in_numpy_files(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    arrays = {
        "xyz": np.ones((5, 3)),
        "colors": np.full((5, 3), 7, np.uint8),
        "names": np.array(["a"] * 5),
        "w": np.eye(5),
    }
    np.savez(tmp_path / "c.npz", **arrays)
    with caplog.at_level(logging.WARNING, "stereo_ore"):
        read = clouds.read(tmp_path / "c.npz")
    assert read.dtype.names == (
        "x",
        "y",
        "z",
        "red",
        "green",
        "blue",
        "w_0",
        "w_1",
        "w_2",
        "w_3",
        "w_4",
    )
    assert "names" in caplog.text
    structured = np.zeros(
        4, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("normals", "f4", 3), ("label", "U3")]
    )
    np.save(tmp_path / "c.npy", structured)
    assert clouds.read(tmp_path / "c.npy").dtype.names == ("x", "y", "z", "nx", "ny", "nz")


def test_padding_fields_of_a_pcd_are_no_columns(tmp_path: Path) -> None:
    text = (
        "FIELDS x y z _ i _\nSIZE 4 4 4 1 4 1\nTYPE F F F U F U\nCOUNT 1 1 1 4 1 12\nWIDTH"
        " 1\nHEIGHT 1\nDATA binary\n"
    )
    body = struct.pack("<fff4sf12s", 1, 2, 3, b"abcd", 9, bytes(12))
    (tmp_path / "c.pcd").write_bytes(text.encode() + body)
    read = clouds.read(tmp_path / "c.pcd")
    assert read.dtype.names == ("x", "y", "z", "i")
    assert read.tolist() == [(1, 2, 3, 9)]


def lzf(data: bytes) -> bytes:
    """LZF by the book, slow: literals, and copies of at least three bytes that came within 8 kB
    before."""
    out, at, run = bytearray(), 0, bytearray()

    def flush() -> None:
        for start in range(0, len(run), 32):
            part = run[start : start + 32]
            out.append(len(part) - 1)
            out.extend(part)
        run.clear()

    while at < len(data):
        window = max(0, at - 8191)
        length = 0
        for size in range(min(264, len(data) - at), 2, -1):
            found = data.rfind(data[at : at + size], window, at + size - 1)
            if found >= 0:
                length = size
                break
        if not length:
            run.append(data[at])
            at += 1
            continue
        flush()
        back = at - found - 1
        short = length - 2
        out.append(min(short, 7) << 5 | back >> 8)
        if short >= 7:
            out.append(short - 7)
        out.append(back & 255)
        at += length
    flush()
    return bytes(out)


@given(
    st.lists(
        st.binary(min_size=1, max_size=40) | st.sampled_from([b"a" * 300, b"abc" * 50]), max_size=6
    ).map(b"".join)
)
@settings(max_examples=60, deadline=None)
def test_lzf(data: bytes) -> None:
    assert decompress(lzf(data), len(data)) == data
    with pytest.raises(ValueError, match=r"hold|end"):
        decompress(lzf(data), len(data) + 1)


# --- what others made of our files: tests/clouds/README.md

STORED = Path(__file__).parent / "clouds"


def twelve_points() -> clouds.Records:
    """With the columns of a run's cloud."""
    i = np.arange(12)
    score = (i / 16).astype(np.float32)
    places = {
        "x": (0.1 * i).astype(np.float32),
        "y": (0.25 - 0.05 * i).astype(np.float32),
        "z": (1 + 0.01 * i * i).astype(np.float32),
    }
    light = {"red": 20 * i, "green": 250 - 20 * i, "blue": 7 * i}
    ore_id = (i // 4).astype(np.int32)
    again = {"scalar_ore_id": ore_id.astype(np.float32), "scalar_score": score, "quality": score}
    return clouds.from_columns(
        places
        | {name: values.astype(np.uint8) for name, values in light.items()}
        | {"ore_id": ore_id, "score": score}
        | again
    )


@pytest.mark.parametrize("file", ["ours.ply", "ours.pcd"])
def test_what_others_read_is_what_is_written_today(file: str, tmp_path: Path) -> None:
    clouds.write(tmp_path / file, twelve_points())
    assert (tmp_path / file).read_bytes() == (STORED / file).read_bytes()


@pytest.mark.parametrize(
    ("file", "columns"),
    [
        ("pcl_ascii.pcd", {"ore_id": "ore_id", "score": "score", "quality": "score"}),
        ("pcl_compressed.pcd", {"ore_id": "ore_id", "score": "score", "quality": "score"}),
        ("pcl.ply", {"ore_id": "ore_id", "score": "score", "quality": "score"}),
        ("pcl_from_ply.pcd", {"ore_id": "ore_id", "score": "score", "quality": "score"}),
        ("cloudcompare.asc", {"ore_id": "ore_id", "score": "score"}),
        ("cloudcompare.ply", {"scalar_ore_id": "ore_id", "scalar_score": "score"}),
        ("meshlab.ply", {"quality": "score"}),
    ],
)
def test_what_others_made_of_it_comes_back(file: str, columns: dict[str, str]) -> None:
    """Places, colours, and those columns that the program keeps, by its own names."""
    expected, found = twelve_points(), clouds.read(STORED / file)
    np.testing.assert_allclose(clouds.xyz(found), clouds.xyz(expected), rtol=3e-6, atol=1e-7)
    assert colours(found) == colours(expected)
    for name, ours in columns.items():
        np.testing.assert_allclose(found[name], expected[ours])


# --- tables and arrays that other tools write

POINTS = np.round(np.random.default_rng(3).uniform(-1, 1, (40, 3)), 4)


def coordinates(path: Path) -> np.ndarray:
    return clouds.xyz(clouds.read(path))


def table(path: Path, header: str, columns: np.ndarray) -> Path:
    rows = "\n".join(",".join(f"{value:.10g}" for value in row) for row in columns)
    path.write_text(f"{header}\n{rows}\n" if header else f"{rows}\n")
    return path


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("header", ["", ",x,y,z", "Unnamed: 0,x,y,z"])
def test_a_column_that_counts_the_rows_is_no_coordinate(
    header: str, first: int, tmp_path: Path
) -> None:
    """pandas' ``to_csv`` and survey points: number, then the three coordinates."""
    counted = np.column_stack([np.arange(40) + first, POINTS])
    np.testing.assert_array_equal(coordinates(table(tmp_path / "x.csv", header, counted)), POINTS)


def test_coordinates_that_happen_to_be_whole_are_coordinates(tmp_path: Path) -> None:
    grid = np.column_stack([np.arange(40) % 20, np.arange(40) // 20, POINTS[:, :2]])
    np.testing.assert_array_equal(coordinates(table(tmp_path / "x.csv", "", grid)), grid[:, :3])
    line = np.column_stack([np.arange(40), POINTS[:, :2]])  # no other three columns are there
    np.testing.assert_array_equal(coordinates(table(tmp_path / "x.csv", "", line)), line)


def test_an_image_of_points_is_read_row_by_row(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What ``cv2.reprojectImageTo3D`` makes, and the ZED's XYZRGBA."""
    for depth in (3, 4):
        image = np.dstack([POINTS.reshape(8, 5, 3), np.ones((8, 5))])[:, :, :depth]
        np.save(tmp_path / "x.npy", image)
        np.testing.assert_array_equal(coordinates(tmp_path / "x.npy"), POINTS)
        np.savez(tmp_path / "x.npz", points=image)
        np.testing.assert_array_equal(coordinates(tmp_path / "x.npz"), POINTS)
    assert "row by row" in caplog.text
    for other in (np.zeros((8, 5, 3), np.uint8), np.zeros((8, 5, 30))):  # a picture, a volume
        np.save(tmp_path / "x.npy", other)
        with pytest.raises(CloudError, match=r"shape \(N, 3 or more\) wanted"):
            clouds.read(tmp_path / "x.npy")


def test_arrays_of_points_under_other_names(tmp_path: Path) -> None:
    colours = np.zeros((40, 3), np.uint8)
    for arrays in ({"positions": POINTS, "colors": colours}, {"arr_0": POINTS}, {"pts": POINTS}):
        np.savez(tmp_path / "x.npz", **arrays)
        np.testing.assert_array_equal(coordinates(tmp_path / "x.npz"), POINTS)
    np.savez(tmp_path / "x.npz", a=POINTS, b=POINTS)
    with pytest.raises(CloudError, match="holds a, b; x, y, z or one of xyz, points"):
        clouds.read(tmp_path / "x.npz")
