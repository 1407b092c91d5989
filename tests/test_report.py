"""report.html: whole in one file, safe against what names contain, small, and right in a real
browser."""

import base64
import json
import re
import shutil
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from runs import cloud, make_run, ore, quarter_scene, record, write_lines

from stereo_ore.errors import MissingExtraError, SourceError
from stereo_ore.io import clouds
from stereo_ore.io.results import Results
from stereo_ore.report import cloud_view, page, write_report
from stereo_ore.report.data import page_data
from stereo_ore.types import Rig

MEGABYTE = 1_000_000
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>{{plotly}}&amp;"


class Page(HTMLParser):
    """Elements of a page, and its data block."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.title, self.headings, self._data, self._in = "", "", "", ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._in = "data" if dict(attrs).get("id") == "data" else tag

    def handle_endtag(self, tag: str) -> None:
        self._in = ""

    def handle_data(self, data: str) -> None:
        if self._in == "data":
            self._data += data
        elif self._in == "title":
            self.title += data

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self._data)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("report") / "pile 7")


@pytest.fixture(scope="module")
def report(folder: Path) -> Page:
    return Page(write_report(folder))


def test_one_file_that_needs_nothing_else(folder: Path, report: Page) -> None:
    assert (folder / "report.html").stat().st_size < 10 * MEGABYTE
    for tag, attributes in report.tags:
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, attributes)
    assert sum(tag == "script" for tag, _ in report.tags) == 3
    assert report.title == "stereo-ore: pile 7"


def test_frames_counts_and_reasons(report: Page) -> None:
    data = report.data
    assert data["statuses"] == {"ok": 2, "failed": 1}
    assert [
        (row["frame"], row["ores"], row["oversize"], row["targets"]) for row in data["frames"]
    ] == [
        ("000000", 2, 1, 2),
        ("000001", 1, 1, 0),
        ("000002", 0, 0, 0),
    ]
    assert data["frames"][0]["largest_m"] == 0.2
    assert data["frames"][1]["stamp_utc"] == "2023-11-14T22:13:20.100000000Z"
    assert data["frames"][2]["reasons"] == ["UNPAIRED: left2.png: has no right partner"]
    assert {(entry["of"], entry["code"], entry["count"]) for entry in data["reasons"]} == {
        ("frame", "UNPAIRED", 1),
        ("ore", "TOO_STEEP", 1),
    }
    assert data["sizes"] == {
        "place": [0, 0, 1],
        "middle_m": [0.2, 0.2, 0.2],
        "oversize": [True, False, True],
    }
    assert data["timings"] == {"read": 9.0, "match": 100.0}
    assert "format: stereo_ore/site" in data["files"]["site.yaml"]
    assert data["opening_m"] > 0


def test_detail_of_a_frame(report: Page) -> None:
    detail = report.data["details"]["0"]
    assert detail["counts"]["pixels"] == 230400
    assert detail["targets"] == [2, 1]
    assert sum(detail["scores"]["kept"]) == 500
    assert sum(detail["scores"]["removed"]) == 100
    assert detail["overlay"].startswith("data:image/jpeg;base64,")
    picture = cv2.imdecode(
        np.frombuffer(base64.b64decode(detail["overlay"].split(",")[1]), np.uint8), cv2.IMREAD_COLOR
    )
    assert np.abs(picture.reshape(-1, 3).mean(0) - (30, 90, 200)).max() < 4
    failed = report.data["details"]["2"]
    assert failed["overlay"] is None
    assert "points" not in failed


def test_points_survive_packing() -> None:
    table = cloud(3)
    packed = cloud_view.pack_cloud(table, 100)
    assert (packed["count"], packed["of"]) == (100, 500)
    xyz = np.frombuffer(base64.b64decode(packed["xyz_mm"]), "<i2").reshape(-1, 3) / 1000
    np.testing.assert_allclose(xyz, clouds.xyz(table[::5]), atol=0.00051)
    np.testing.assert_array_equal(
        np.frombuffer(base64.b64decode(packed["ore"]), "<u2"), table["ore_id"][::5]
    )


def test_noise_map_is_the_formula_where_there_are_points() -> None:
    rig = Rig(960, 540, 500.0, 500.0, 480.0, 270.0, 0.12)
    xyz = np.array(
        [[0.0, 0.0, 2.0], [0.01, 0.0, 2.0], [0.4, 0.2, 1.0], [9.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    )
    noise = cloud_view.noise_map(xyz, rig, 0.2)
    grid = np.array(noise["mm"], float)
    assert grid.shape == (54, 96)
    assert np.isfinite(grid).sum() == 2
    assert grid[27, 48] == pytest.approx(1000 * 4 / (500 * 0.12) * 0.2, abs=0.01)
    assert grid[37, 68] == pytest.approx(1000 * 1 / (500 * 0.12) * 0.2, abs=0.01)


@pytest.mark.parametrize("values", [[], [0.5], [0.5] * 9, [np.nan, np.inf, 1.0]])
def test_scores_of_degenerate_clouds(values: list[float]) -> None:
    table = cloud(0, len(values))
    table["score"] = values
    found = cloud_view.scores(table, None)
    assert sum(found["kept"]) == np.isfinite(values).sum()
    json.dumps(found, allow_nan=False)


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    reasons = [{"code": "UNPAIRED", "detail": HOSTILE}]
    folder = make_run(tmp_path / "run", [record(0, [], "degraded", reasons=reasons)])
    (folder / "config.yaml").write_text(f"# {HOSTILE}\nmatching: {{sigma_px: 0.2}}\n")
    run = json.loads((folder / "run.json").read_text()) | {"source": HOSTILE}
    (folder / "run.json").write_text(json.dumps(run))
    html = Page(write_report(folder))
    assert sum(tag == "script" for tag, _ in html.tags) == 3
    assert not any("onerror" in attributes for _, attributes in html.tags)
    assert html.data["run"]["source"] == HOSTILE
    assert html.data["files"]["config.yaml"].startswith(f"# {HOSTILE}\n")
    titled = tmp_path / "titled.html"
    titled.write_text(page.render({}, HOSTILE))
    assert Page(titled).title == f"stereo-ore: {HOSTILE}"


def test_thousands_of_frames_stay_small_and_quick(tmp_path: Path) -> None:
    folder = make_run(
        tmp_path / "run", [record(n, [ore(i) for i in range(1, 9)]) for n in range(4000)]
    )
    start = time.process_time()
    html = Page(write_report(folder))
    assert time.process_time() - start < 15
    assert (folder / "report.html").stat().st_size < 10 * MEGABYTE
    assert html.data["frames_total"] == 4000
    assert len(html.data["frames"]) == 3000
    assert len(html.data["details"]) == 8
    assert html.data["frames"][-1]["frame"] == "003999"
    assert len(html.data["sizes"]["place"]) <= 6000


def test_unfinished_run_and_missing_or_damaged_files(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", stages=False)
    text = (folder / "frames.jsonl").read_text()
    (folder / "frames.jsonl").unlink()
    (folder / "frames.jsonl.part").write_text(text[: len(text) - 30])  # killed in the third line
    for name in ("timings.jsonl", "run.json", "calibration.yaml", "site.yaml"):
        (folder / name).unlink()
    (folder / "overlays" / "000000.png").write_bytes(b"no picture")
    (folder / "clouds" / "000001.ply").unlink()
    data = Page(write_report(folder)).data
    assert data["run"]["finished"] is False
    assert data["frames_total"] == 2
    assert data["details"]["0"]["overlay"] is None
    assert data["details"]["0"]["noise"] is None
    assert "points" not in data["details"]["1"]


def test_run_without_frames(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", [])
    assert Page(write_report(folder)).data["frames"] == []


def test_calibration_verdict_is_shown(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    verdict = {"frame": "000000", "verdict": "wrong", "text": "rows differ", "findings": []}
    (folder / "calibration_check.json").write_text(json.dumps(verdict))
    assert Page(write_report(folder)).data["check"] == verdict


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("nonsense\n", "line 1 is no JSON object"),
        ('{"frame": "half of a pair: \\ud800"}\n', "line 1 is no record of stereo_ore/frame/2"),
        ('{"schema": "other"}\n', "line 1 is no record of stereo_ore/frame/2"),
    ],
)
def test_what_is_no_run(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"holds no frames\.jsonl"):
        write_report(tmp_path)
    (tmp_path / "frames.jsonl").write_text(content)
    with pytest.raises(SourceError, match=message):
        write_report(tmp_path)


def test_command(folder: Path) -> None:
    done = subprocess.run(
        ["stereo-ore", "report", folder], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout.strip()) == (0, str(folder / "report.html"))


def test_run_checks_the_calibration_and_writes_the_report_unless_told_not_to(
    tmp_path: Path,
) -> None:
    files, out = quarter_scene(tmp_path / "scene"), tmp_path / "out"

    def run(*more: str) -> None:
        command = ["stereo-ore", "run", str(tmp_path / "scene"), *files, "--out", str(out), *more]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr

    run()
    data = Page(out / "report.html").data
    assert data["run"]["finished"] is True
    assert data["check"]["verdict"] in ("good", "unclear", "suspect")
    assert data["check"]["frame"] == "scene"
    assert data["details"]["0"]["points"]["count"] > 100
    run("--overwrite", "--no-report")
    assert not (out / "report.html").exists()
    assert not (out / "calibration_check.json").exists()


def test_no_heavy_package_is_imported(folder: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from stereo_ore.report import"
        f" write_report\nwrite_report(Path({str(folder)!r}))\nprint([name for name in ('plotly',"
        " 'open3d', 'sklearn', 'matplotlib', 'pandas') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


def test_frames_without_a_3d_view_have_their_ores(tmp_path: Path) -> None:
    records = [record(n, [ore(1), ore(2)]) for n in range(20)]
    data = page_data(Results(make_run(tmp_path / "run", records, stages=False)))
    assert len(data["tables"]) == 20 - len(data["details"])
    assert not data["tables"].keys() & data["details"].keys()
    assert all([ore["id"] for ore in table["ores"]] == [1, 2] for table in data["tables"].values())
    assert all(table["targets"] == [2, 1] for table in data["tables"].values())


def test_without_plotly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="plotly is not installed"):
        page.render({}, "x")


# --- in a browser

PROBE = """
<script>
const wait = setInterval(() => {
  if (document.body.dataset.cloud === "drawing") return;
  clearInterval(wait);
  const rows = id => [...document.querySelectorAll(`#${id} tbody tr`)];
  const column = (id, number) => rows(id).map(row => row.children[number].textContent);
  const press = (id, number) => document.querySelectorAll(`#${id} thead button`)[number].click();
  const found = { frames: [], ores: column("ores", 0),
                  title: document.querySelector("#frame-title").textContent };
  for (let i = 0; i < 2; i++) { press("frames", 3); found.frames.push(column("frames", 1)); }
  press("ores", 1);
  found.by_target = column("ores", 0);
  found.strip = document.querySelectorAll("#strip button").length;
  found.bars = document.querySelectorAll("#counts .bar").length;
  found.sizes = document.querySelectorAll("#sizes .point").length;
  Plotly.toImage("cloud", { format: "png", width: 600, height: 400 }).then(url => {
    found.cloud = url;
    rows("frames").at(-1).click();
    found.clicked = document.querySelector("#frame-title").textContent;
    const content = { id: "found", textContent: JSON.stringify(found) };
    const text = Object.assign(document.createElement("pre"), content);
    document.body.append(text);
  });
}, 100);
</script>
"""
BROWSER = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--enable-logging=stderr", "--timeout=90000",
    "--virtual-time-budget=60000",
    "--dump-dom",
)  # fmt: skip


def browse(
    path: Path, probe: str = PROBE, size: str = "1400,1000"
) -> tuple[dict[str, Any], list[str]]:
    """What the probe found in the page, and what the console said that is worse than
    information."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium here")
    probed = path.with_name("probed.html")
    probed.write_text(path.read_text().replace("</body>\n</html>", probe + "</body></html>"))
    home = f"--user-data-dir={path.parent / 'profile'}"
    done = subprocess.run(
        [browser, *BROWSER, f"--window-size={size}", home, probed.as_uri()],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    console = [
        line
        for line in done.stderr.splitlines()
        if "CONSOLE" in line and "INFO:CONSOLE" not in line
    ]
    assert "Uncaught" not in done.stderr
    match = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    assert match, done.stderr[-2000:]
    return (
        json.loads(match[1].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")),
        console,
    )


@pytest.mark.slow
def test_in_a_browser_the_3d_view_is_drawn_tables_sort_and_nothing_complains(
    tmp_path: Path,
) -> None:
    folder = make_run(tmp_path / "run")
    found, console = browse(write_report(folder))
    assert console == []
    assert found["title"] == "Frame 000000: ok, 2 ores, 2 targets"
    assert found["frames"] == [["000002", "000001", "000000"], ["000000", "000001", "000002"]]
    assert (found["ores"], found["by_target"]) == (["2", "1"], ["2", "1"])
    assert (found["strip"], found["bars"], found["sizes"]) == (3, 7, 3)
    assert found["clicked"] == "Frame 000002: failed, 0 ores, 0 targets"
    data = base64.b64decode(found["cloud"].split(",")[1])
    pixels = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).reshape(-1, 3).astype(int)
    )
    red_box = (np.abs(pixels - (0x28, 0x27, 0xD6)).max(1) < 60).sum()
    ore_blue = (np.abs(pixels - (0xBD, 0x82, 0x31)).max(1) < 40).sum()
    assert red_box > 50
    assert ore_blue > 50


EACH_FRAME = """
<script>
const wait = setInterval(() => {
  if (document.body.dataset.cloud === "drawing") return;
  clearInterval(wait);
  const visible = id => document.getElementById(id).offsetParent !== null;
  const seen = data.frames.map((frame, place) => {
    choose(place);
    const rows = visible("ores") ? [...document.querySelectorAll("#ores tbody tr")] : [];
    return [document.querySelector("#frame-title").textContent, rows.length, visible("detail"),
            rows.map(row => row.children[1].textContent)];
  });
  const wide = document.documentElement.scrollWidth - window.innerWidth;
  const content = { id: "found", textContent: JSON.stringify({ seen, wide }) };
  document.body.append(Object.assign(document.createElement("pre"), content));
}, 100);
</script>
"""


@pytest.mark.slow
@pytest.mark.parametrize(("frames", "size"), [(1, "390,844"), (60, "1366,768"), (600, "1920,1080")])
def test_in_a_browser_each_frame_has_its_own_numbers_at_any_size(
    frames: int, size: str, tmp_path: Path
) -> None:
    records = [record(n, [ore(1), ore(2), ore(3)][: n % 4]) for n in range(frames)]
    report = write_report(make_run(tmp_path / "run", records))
    assert report.stat().st_size < (10 if frames <= 60 else 20) * MEGABYTE
    found, console = browse(report, EACH_FRAME, size)
    assert console == []
    assert len(found["seen"]) == frames
    for number, (title, rows, _, ranks) in enumerate(found["seen"]):
        ores = number % 4
        assert title.startswith(f"Frame {number:06d}: ok, {ores} ore")
        assert rows == ores, number
        assert ranks == [str(rank) for rank in range(1, ores + 1)]
    assert found["wide"] <= 0
    assert 0 < sum(detailed for _, _, detailed, _ in found["seen"]) <= 8


MARKS = """
<script>
const wait = setInterval(() => {
  if (document.body.dataset.cloud === "drawing") return;
  clearInterval(wait);
  const chosen = id => [...document.querySelectorAll(`#${id} tbody tr.chosen`)].map(
    row => row.children[0].textContent);
  const body = () => at("cloud").data.at(-1).x.length;
  const state = () => [[...document.querySelectorAll("#lumps .marked")].map(s => s.dataset.ore),
                       chosen("ores"), body()];
  const rows = () => [...document.querySelectorAll("#ores tbody tr")];
  const key = name => document.body.dispatchEvent(
    new KeyboardEvent("keydown", { key: name, bubbles: true }));
  const title = () => document.querySelector("#frame-title").textContent.split(":")[0];
  const numbers = at("cloud").data.find(trace => trace.name === "numbers").text;
  const found = { at_first: state(), numbers };
  document.querySelector('#lumps [data-ore="1"]').dispatchEvent(new MouseEvent("click"));
  found.picture = state();
  document.querySelector("#ores thead button").click();
  found.sorted = state();
  rows().find(row => row.children[0].textContent === "2").click();
  found.row = state();
  at("cloud").emit("plotly_click", { points: [{ customdata: 1 }] });
  found.cloud = state();
  at("cloud").emit("plotly_click", { points: [{ customdata: 1 }] });
  found.again = state();
  found.keys = ["ArrowRight", "ArrowRight", "ArrowRight", "ArrowLeft"].map(
    name => (key(name), title()));
  document.querySelector('[data-filter="bad"]').click();
  found.bad = [title(), document.querySelectorAll("#frames tbody tr").length,
               document.querySelectorAll("#strip button").length, chosen("frames")];
  const content = { id: "found", textContent: JSON.stringify(found) };
  document.body.append(Object.assign(document.createElement("pre"), content));
}, 100);
</script>
"""


@pytest.mark.slow
def test_in_a_browser_a_lump_is_marked_everywhere_and_frames_are_gone_through(
    tmp_path: Path,
) -> None:
    records = [record(0, [ore(1), ore(2)]), record(1, [], "failed"), record(2, [ore(1)])]
    found, console = browse(write_report(make_run(tmp_path / "run", records)), MARKS)
    assert console == []
    edges = 12 * 3
    assert found["at_first"] == found["again"] == [[], [], 0]
    assert found["numbers"] == ["[2] 1", "[1] 2"]
    for place, id in (("picture", "1"), ("sorted", "1"), ("row", "2"), ("cloud", "1")):
        assert found[place] == [[id], [id], edges], place
    assert found["keys"] == [f"Frame 00000{number}" for number in (1, 2, 2, 1)]
    assert found["bad"] == ["Frame 000001", 1, 1, ["1"]]


def test_a_lump_can_be_clicked_where_it_is_seen(folder: Path, report: Page) -> None:
    rig = Results(folder).rig
    assert rig is not None
    width, height = report.data["image_px"]
    for lump in report.data["details"]["0"]["ores"]:
        outline = np.array(lump["outline_px"], np.float32)
        assert (outline >= 0).all()
        assert (outline <= (width, height)).all()
        x, y, z = lump["surface_centroid"]["camera"]
        u, v = rig.project([x, y, z])
        assert cv2.pointPolygonTest(outline, (float(u), float(v)), False) >= 0


@pytest.mark.slow
def test_in_a_browser_hostile_names_run_no_script(tmp_path: Path) -> None:
    reasons = [{"code": "UNPAIRED", "detail": HOSTILE}]
    folder = make_run(tmp_path / "run")
    write_lines(
        folder / "frames.jsonl",
        [record(0, [ore(1)], reasons=reasons), record(1, [ore(1)], reasons=reasons)],
    )
    found, console = browse(write_report(folder))
    assert console == []
    assert found["clicked"].startswith("Frame 00000")
