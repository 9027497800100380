"""`probcal watch`: files that grow, standard input, rows that cannot be taken, and processes that are killed."""

import io
import json
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib import image
from terminal import call

import probcal as pc
from probcal.plots import plot_history

MODEL = """
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, Target, sensor

@sensor(east=Channel("m", std=1.0), north=Channel("m", std=1.0))
def plain(target, pose, *, shift=Bias("m", 2.0)):
    place = target.position - pose.position
    return dict(east=place[0] + shift, north=place[1])

def problem(data=None):
    network = Network([plain.on(Node(f"n{k}", (10.0 * k, 0.0))) for k in range(2)])
    motion = Target(ConstantVelocity(0.5), {"position": ((0.0, 0.0), 5.0), "velocity": ((1.0, 0.0), 1.0)})
    return Problem(network, motion, data)
"""

ON_ROAD = "from probcal import Road, RoadNetwork\n" + MODEL.replace(
    'Target(ConstantVelocity(0.5), {"position": ((0.0, 0.0), 5.0), "velocity": ((1.0, 0.0), 1.0)})',
    'Road(RoadNetwork.from_lines({"west": [(-9.0, 0.0), (20.0, 0.0)], "east": [(20.0, 0.0), (90.0, 0.0)],'
    ' "north": [(20.0, 0.0), (20.0, 60.0)]}), 0.1, (1.0, 0.2), ((0.0, 0.0), 2.0), fastest=3.0)',
)


def lines(count=40):
    rng, found = np.random.default_rng(0), ["time,sensor,east,north\n"]
    for k in range(count):
        for n in range(2):
            east, north = k - 10.0 * n + 1.5 * n + rng.normal(), rng.normal()
            found.append(f"{k},n{n},{east:.6f},{north:.6f}\n")
    return found


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "small.py"
    path.write_text(MODEL)
    return path


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("".join(lines()))
    return path


def last(folder):
    history = pd.read_csv(folder / "biases.csv")
    return history[history["time"] == history["time"].max()].drop_duplicates("bias", keep="last").set_index("bias")


@pytest.mark.ci
def test_a_file_is_watched_to_its_end(model, table, tmp_path):
    out = tmp_path / "out"
    code, printed, _ = call("watch", model, table, "--out", out, "--keep", "tracks,rows", "--lag", "8")
    assert code == 0
    assert "80 rows up to time 39 s" in printed
    assert (out / "rows.csv").read_text() == table.read_text()
    assert image.imread(out / "biases.png").std() > 0.02
    assert len(pd.read_csv(out / "tracks.csv")) == 40
    tree = pc.load(out)
    assert tree["calibration"]["mean"].sel(bias_label="n1.shift") == pytest.approx(last(out)["mean"]["n1.shift"])
    assert last(out)["rows"].eq(80).all()
    code, printed, _ = call("watch", model, table, "--out", out, "--lag", "8")
    assert code == 0
    assert "80 rows up to time 39 s" in printed
    code, _, said = call("watch", model, table, "--out", out, "--lag", "16")
    assert code == 2
    assert "is the checkpoint of other settings" in said
    table.write_text("".join(lines()[:5]))
    code, _, said = call("watch", model, table, "--out", out, "--lag", "8")
    assert code == 2
    assert "is shorter than what was read of it; it is another file: give another --out" in said


@pytest.mark.ci
def test_a_file_that_grows_is_read_on(model, table, tmp_path):
    whole, pieces, text = tmp_path / "whole", tmp_path / "pieces", lines()
    assert call("watch", model, table, "--out", whole, "--lag", "0")[0] == 0
    for count in (7, 33, len(text)):
        table.write_text("".join(text[:count])[: None if count == len(text) else -3])  # a line may be half there
        assert call("watch", model, table, "--out", pieces, "--lag", "0")[0] == 0
    one, other = last(whole), last(pieces)
    np.testing.assert_allclose(one["sd"], other["sd"], rtol=1e-2)


@pytest.mark.ci
def test_a_scan_in_two_blocks_is_one_state_of_its_target(model, table, tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr("probcal.stream.watch.BLOCK", 53)
    assert call("watch", model, table, "--out", out, "--keep", "tracks", "--lag", "0")[0] == 0
    tracks = pd.read_csv(out / "tracks.csv")
    assert tracks["time"].tolist() == list(range(40))
    monkeypatch.undo()
    assert call("watch", model, table, "--out", tmp_path / "whole", "--keep", "tracks", "--lag", "0")[0] == 0
    whole = pd.read_csv(tmp_path / "whole" / "tracks.csv")
    np.testing.assert_allclose(tracks["position_x"], whole["position_x"], atol=1e-9)


@pytest.mark.ci
def test_lines_are_counted_on_after_a_restart(model, table, tmp_path):
    text, out = lines(), tmp_path / "out"
    table.write_text("".join(text[:21]))
    assert call("watch", model, table, "--out", out, "--lag", "0")[0] == 0
    table.write_text("".join([*text[:31], "15,n7,1.0,2.0\n", *text[31:]]))
    assert call("watch", model, table, "--out", out, "--lag", "0")[0] == 0
    assert pd.read_csv(out / "refused.csv")["line"].tolist() == [32]
    assert last(out)["rows"].eq(80).all()
    assert (
        "80 rows up to time 39 s, 1 left out (see refused.csv)"
        in call("watch", model, table, "--out", out, "--lag", "0")[1]
    )


@pytest.mark.ci
def test_particles_go_on_where_they_were(model, table, tmp_path):
    text, options = lines(), ("--particles", "200", "--keep", "rows")
    assert call("watch", model, table, "--out", tmp_path / "whole", *options)[0] == 0
    out = tmp_path / "out"
    for count in (41, len(text)):
        table.write_text("".join(text[:count]))
        code, printed, _ = call("watch", model, table, "--out", out, *options)
        assert code == 0
    assert "80 rows up to time 39 s" in printed
    assert (out / "rows.csv").read_text() == table.read_text()
    one, other = last(tmp_path / "whole"), last(out)
    assert (np.abs(one["mean"] - other["mean"]) < 1.5 * one["sd"]).all()  # other draws
    code, _, said = call("watch", model, table, "--particles", "50", "--lag", "8")
    assert code == 2
    assert "--particles filters without --lag; give one of the two" in said


@pytest.mark.slow
@pytest.mark.needs("roads")
def test_who_is_on_a_road_is_filtered_and_who_cannot_be_sure_is_told(model, table, tmp_path):
    model.write_text(ON_ROAD)
    out = tmp_path / "out"
    code, printed, _ = call("watch", model, table, "--out", out, "--particles", "300")
    assert code == 0
    found = last(out)
    assert found["mean"]["n1.shift"] - found["mean"]["n0.shift"] == pytest.approx(1.5, abs=1.0)
    assert (found["gamma"] > 0.3).all()
    assert "of the first particles are left: take more" in printed
    assert pc.load(out).attrs["status"] == "not converged"
    assert "Intervals may be too narrow." in pc.load(out).attrs["message"]


@pytest.mark.ci
def test_rows_at_which_a_watch_is_told_to_end_are_taken_whole(model, table, tmp_path, monkeypatch):
    out, update = tmp_path / "out", pc.Online.update

    def told(self, rows):
        signal.raise_signal(signal.SIGTERM)
        return update(self, rows)

    options = ("watch", model, table, "--out", out, "--lag", "0", "--keep", "rows")
    monkeypatch.setattr("probcal.stream.watch.BLOCK", 200)
    with monkeypatch.context() as patched:
        patched.setattr(pc.Online, "update", told)
        code, printed, _ = call(*options)
    assert code == 0
    assert "80 rows" not in printed
    assert 0 < last(out)["rows"].max() < 80
    code, printed, _ = call(*options)
    assert "80 rows up to time 39 s" in printed
    assert "late" not in printed
    assert (out / "rows.csv").read_text() == table.read_text()


@pytest.mark.ci
def test_standard_input_is_watched(model, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO("".join(lines()).encode())))
    code, printed, _ = call("watch", model, "--lag", "0")
    assert code == 0
    assert "n1.shift" in printed
    assert "80 rows up to time 39 s" in printed


@pytest.mark.ci
def test_rows_that_cannot_be_taken_are_put_aside(model, table, tmp_path):
    text, out = lines(), tmp_path / "out"
    bad = [*text[:20], "9,n7,1.0,2.0\n", *text[20:30], "nonsense,n1,1.0,2.0\n", *text[30:], text[-1]]
    table.write_text("".join(bad))
    code, printed, _ = call("watch", model, table, "--out", out, "--lag", "0")
    assert code == 0
    refused = pd.read_csv(out / "refused.csv")
    assert refused["line"].tolist() == [21, 32]
    assert 'sensor "n7" is not in the network' in refused["reason"][0]
    assert "1 duplicates, 2 left out (see refused.csv)" in printed


@pytest.mark.ci
def test_a_row_that_cannot_be_meant_is_put_aside_wherever_it_stands(model, table, tmp_path):
    model.write_text(MODEL.replace("std=1.0)", "std=1.0, noise=StudentT(4.0))").replace("Target,", "StudentT, Target,"))
    text = lines()
    for k in (5, 42, 80):
        time_, sensor, _, north = text[k].split(",")
        text[k] = f"{time_},{sensor},-9999,{north}"
    text[20] = "9,n7,1.0,2.0\n"
    table.write_text("".join(text))
    code, printed, _ = call("watch", model, table, "--out", tmp_path / "out", "--lag", "8")
    assert code == 0
    refused = pd.read_csv(tmp_path / "out" / "refused.csv").sort_values("line")
    assert refused["line"].tolist() == [6, 21, 43, 81]
    assert refused["reason"].iloc[3].startswith('rows.csv row 81 column "east": -9999 looks like a mark for a missing')
    assert "4 left out (see refused.csv)" in printed
    assert pc.load(tmp_path / "out").attrs["stream_refused"] == 3


@pytest.mark.ci
def test_a_first_table_of_nonsense_ends_in_one_sentence(model, table, tmp_path):
    text = lines()
    (tmp_path / "own.csv").write_text("".join(text))
    model.write_text(MODEL.replace("motion, data)", f"motion, {str(tmp_path / 'own.csv')!r})"))
    stamps = [f"{1.7e12 + k:.0f},{line.partition(',')[2]}" for k, line in enumerate(text[1:])]
    table.write_text("".join([text[0], *stamps]))
    code, _, said = call("watch", model, table)
    assert code == 2
    assert "the first 50 rows cannot be taken: rows.csv row 2 column" in said.replace("\n", " ")
    assert "looks like ms since 1970; write the header as time [ms]" in said.replace("\n", " ")


@pytest.mark.ci
@pytest.mark.parametrize("since", [None, "2026-05-01T00:00:00Z"], ids=["seconds", "dates"])
def test_rows_of_the_calibration_are_not_counted_again(model, table, tmp_path, since, monkeypatch):
    monkeypatch.setattr("probcal.stream.online.RECENT", 10)
    text = lines()
    if since is not None:
        stamps = [pd.Timestamp(since) + pd.Timedelta(line.partition(",")[0] + "s") for line in text[1:]]
        rest = [line.partition(",")[2] for line in text[1:]]
        text = [text[0], *(f"{t.isoformat()},{own}" for t, own in zip(stamps, rest, strict=True))]
    table.write_text("".join(text[:61]))
    options = ("watch", model, table, "--lag", "8", "--gate", "0", "--out")
    assert call(*options, tmp_path / "one")[0] == 0
    code, _, said = call(*options, tmp_path / "again", "--calibration", tmp_path / "one")
    assert code == 2
    assert "rows.csv: the calibration has counted all its rows; watch rows that came later" in said.replace("\n", " ")
    table.write_text("".join(text))
    code, printed, _ = call(*options, tmp_path / "two", "--calibration", tmp_path / "one")
    assert code == 0
    assert "60 left out (see refused.csv)" in printed
    assert pd.read_csv(tmp_path / "two" / "refused.csv")["line"].tolist() == list(range(2, 62))


@pytest.mark.ci
def test_rows_are_filtered_at_common_epochs(model, table):
    model.write_text(MODEL.replace("motion, data)", "motion, data, epoch=2.0)"))
    code, printed, _ = call("watch", model, table, "--lag", "8")
    assert code == 0
    assert "80 rows up to time 40 s" in printed


@pytest.mark.ci
@pytest.mark.needs("roads")
def test_what_is_wrong_is_said(model, table, tmp_path):
    wrong = {
        ("--keep", "x", "--out", tmp_path): 'keep "x" is not known; give tracks, rows or both, separated by a comma',
        ("--keep", "rows"): "--keep needs --out, the folder of the tables",
        ("--walk", "n0.shift"): 'walk "n0.shift": write PATTERN=STD, the positive standard deviation over one second',
        ("--walk", "x.*=1.0"): 'walk "x.*" matches no bias',
        ("--consider", "y"): 'consider "y" matches no bias',
        ("--calibration", tmp_path / "none"): "is not a fit written by probcal",
    }
    for options, said in wrong.items():
        code, _, printed = call("watch", model, table, *options)
        assert code == 2
        assert said in printed
    road = tmp_path / "road.py"
    road.write_text(ON_ROAD)
    code, _, printed = call("watch", road, table)
    assert code == 2
    assert "moves by Road, which has no linear form" in printed
    table.write_text("time,sensor,west\n1,n0,2\n")
    code, _, printed = call("watch", model, table)
    assert code == 2
    assert "west" in printed
    good = tmp_path / "good.py"
    good.write_text(MODEL.replace("motion, data)", "motion, " + repr(str(tmp_path / "own.csv")) + ")"))
    (tmp_path / "own.csv").write_text("".join(lines()))
    table.write_text("time,sensor,east,north\n" + "1,n9,2.0,3.0\n" * 60)
    code, _, printed = call("watch", good, table)
    assert code == 2
    assert 'the first 50 rows cannot be taken: rows.csv row 2: sensor "n9" is not in' in printed
    table.write_text("time,sensor,east,north\n")
    code, _, printed = call("watch", good, table)
    assert code == 2
    assert "rows.csv has no rows that could be taken" in printed


def edited(text):
    """Rows of the same length, one cell of which differs."""
    return text.replace(",n0,", ",n1,", 1)


@pytest.mark.ci
def test_a_stream_goes_on_in_the_file_that_it_began_in(model, table, tmp_path):
    out, text = tmp_path / "out", "".join(lines())
    options = ("watch", model, table, "--out", out, "--lag", "0")
    assert call(*options)[0] == 0
    for other, why in {
        edited(text): "its first 81 lines are not those that were read; it is another file, or was edited: restore it",
        text.replace(
            "east,north", "north,east"
        ): "its header has changed since it was read; restore it, or give another --out",
    }.items():
        assert len(other) == len(text)
        table.write_text(other + text[-30:])
        code, _, said = call(*options)
        assert code == 2
        assert f"{table}: {why}" in said
    table.write_text(text)
    assert call(*options)[0] == 0


@pytest.mark.ci
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_last_line_without_an_end_is_taken_once(end, model, table, tmp_path):
    out, text = tmp_path / "out", lines()
    options = ("watch", model, table, "--out", out, "--lag", "0", "--keep", "rows")
    for count in (41, 41, 61, 81):
        content = "".join(text[:count]).replace("\n", end).encode()
        table.write_bytes(content.rstrip())
        code, printed, _ = call(*options)
        assert code == 0
        assert f"{count - 1} rows" in printed
        assert "left out" not in printed
        assert (out / "rows.csv").read_bytes().split() == content.split()
    table.write_bytes(table.read_bytes() + f"{end}50,n7,1.0,2.0{end}".encode())
    assert call(*options)[0] == 0
    assert pd.read_csv(out / "refused.csv")["line"].tolist() == [82]


@pytest.mark.ci
def test_a_state_of_another_model_is_refused(model, table, tmp_path):
    out = tmp_path / "out"
    options = ("watch", model, table, "--out", out, "--lag", "0")
    assert call(*options)[0] == 0
    network = pc.write_network(tmp_path / "network.csv", pc.load(out) and place(model).network)
    for old, new, name in (
        ("place[1])", "1.01 * place[1])", "sensor plain"), ("std=1.0", "std=2.0", "sensor plain"),
        ("10.0 * k", "11.0 * k", "node n1"), ('"m", 2.0', '"m", 3.0', "sensor plain"), ("(0.5)", "(0.6)", "motion"),
    ):  # fmt: skip
        model.write_text(MODEL.replace(old, new))
        code, _, said = call(*options)
        assert code == 2
        assert f"{out / 'watch.npz'}: the {name} has changed since the run there began" in said
        assert "give another --out, or move it away" in said
    model.write_text(MODEL)
    network.write_text(network.read_text().replace("n1.shift,sensor,m,0.0,", "n1.shift,sensor,m,1.0,0.5"))
    code, _, said = call(*options, "--network", network)
    assert code == 2
    assert "the sensor n1 has changed" in said
    code, _, said = call(*options, "--calibration", out)
    assert code == 2
    assert "the calibration has changed" in said
    assert call(*options)[0] == 0


def place(model):
    found = {}
    exec(model.read_text(), found)
    return found["problem"](pd.DataFrame({"time": [0.0], "sensor": ["n0"], "east": [1.0], "north": [1.0]}))


@pytest.mark.ci
def test_a_damaged_state_or_table_is_one_sentence(model, table, tmp_path):
    out = tmp_path / "out"
    options = ("watch", model, table, "--out", out, "--lag", "0")
    assert call(*options)[0] == 0
    state, history = out / "watch.npz", out / "biases.csv"
    whole, note = state.read_bytes(), out / ".probcal.json"
    for path, content, why in (
        (state, whole[:-9], "is damaged, or no state of this version of probcal watch; move it away to begin anew"),
        (state, b"", "is damaged, or no state of this version of probcal watch; move it away to begin anew"),
        (history, history.read_bytes()[:-9], "is shorter than watch.npz says; restore it, or move watch.npz away"),
    ):
        before = path.read_bytes()
        path.write_bytes(content)
        note.write_text(json.dumps({name: ["", ""] for name in json.loads(note.read_text())}))  # as a kill leaves it
        code, _, said = call(*options)
        assert code == 2
        assert f"{path} {why}" in said
        path.write_bytes(before)
    assert call(*options)[0] == 0


@pytest.mark.ci
@pytest.mark.skipif(sys.platform == "win32", reason="no limits of files")
def test_a_full_disk_is_one_sentence_and_the_state_stays_whole(model, table, tmp_path, monkeypatch):
    """Files of a process may have this many bytes: what is too long for one is written to its limit, then fails."""
    import resource

    monkeypatch.setattr("probcal.stream.watch.BLOCK", 300)
    options = ("watch", model, table, "--lag", "0", "--every", "0", "--keep", "tracks,rows", "--out")
    assert call(*options, tmp_path / "whole")[0] == 0
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "whole").iterdir()}
    out, failed, soft = tmp_path / "out", set(), resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in sorted({*sizes.values(), 400, 1200}):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, soft[1]))
        try:
            code, _, said = call(*options, out)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, soft)
        if code:
            assert code == 2
            assert re.fullmatch(r"probcal: \S+ cannot be written: File too large\n", said.splitlines(True)[-1])
            failed.add(Path(said.splitlines()[-1].split()[1]).name)
        assert not list(out.glob("*.part"))
    assert {"tracks.csv", "watch.npz", "fit.nc"} <= failed
    assert call(*options, out)[0] == 0
    for name in ("tracks.csv", "rows.csv"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    pd.testing.assert_frame_equal(last(out), last(tmp_path / "whole"))


@pytest.mark.ci
def test_progress_of_a_file_has_rows_rate_and_share(model, table, monkeypatch):
    @contextmanager
    def shown():
        yield seen.append

    seen = []
    monkeypatch.setattr("probcal.stream.watch.shown", shown)
    monkeypatch.setattr("probcal.stream.watch.BLOCK", 700)
    assert call("watch", model, table, "--lag", "0")[0] == 0
    first, begun, *blocks, end = map(str, seen)
    assert first.startswith("watch: rows.csv, start, ")
    assert begun.startswith("watch: rows.csv, first rows, ")
    assert len(blocks) > 2
    assert re.fullmatch(
        r"watch: \d+ rows up to time \d+ s, [\d,]+ rows per s, \d+% of rows.csv, \d+ s, about \d+ s left", blocks[0]
    )
    assert "80 rows up to time 39 s" in end
    assert "100% of rows.csv" in end


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "probcal.cli", "watch", *map(str, arguments)], stdout=subprocess.PIPE, text=True
    )


def wait_for(path, least=1):
    for _ in range(600):
        if path.exists() and path.stat().st_size >= least:
            return
        time.sleep(0.1)
    raise AssertionError(f"{path} did not come")


@pytest.mark.slow
def test_a_killed_watch_goes_on_and_counts_every_row_once(model, table, tmp_path):
    out, text = tmp_path / "out", lines()
    options = (model, table, "--out", out, "--lag", "8", "--every", "0")
    assert call("watch", model, table, "--out", tmp_path / "whole", "--lag", "8")[0] == 0
    table.write_text("".join(text[:30]))
    process = started(*options, "--follow")
    wait_for(out / "watch.npz")
    for count in (45, 60):
        before = (out / "biases.csv").stat().st_size
        table.write_text("".join(text[:count]))
        wait_for(out / "biases.csv", before + 1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        process = started(*options, "--follow")
    table.write_text("".join(text))
    for _ in range(600):
        if last(out)["rows"].max() == 80:
            break
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    printed, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "80 rows up to time 39 s" in printed
    assert "duplicates" not in printed
    np.testing.assert_allclose(last(out)["mean"], last(tmp_path / "whole")["mean"], atol=0.02)


@pytest.mark.ci
def test_a_history_is_drawn_with_its_jumps():
    times = np.arange(5.0)
    row = {"unit": "rad", "sd": 0.1, "lower": 0.0, "upper": 0.2}
    history = pd.DataFrame([row | {"time": t, "bias": b, "mean": 0.1} for t in times for b in ("a.x", "b.x")])
    jumps = pd.DataFrame([{"label": "b.x", "since": 2.0, "found": 3.0}])
    first, second = plot_history(history, jumps=jumps).axes
    assert len(first.lines) == 2
    assert [line.get_xdata()[0] for line in second.lines[2:]] == [2.0, 3.0]
    assert second.lines[1].get_ydata() == pytest.approx(np.rad2deg(np.full(5, 0.1)))
    assert len(plot_history(history, ["a.x"]).axes) == 1
    (alone,) = plot_history(pd.concat([history[:1], history[:1]])).axes
    assert alone.lines[1].get_marker() == "o"
    with pytest.raises(pc.InputError, match=r'plot_history: no bias is called "c\.x"'):
        plot_history(history, ["c.x"])
    with pytest.raises(pc.InputError, match='plot_history: the history has no column "sd"'):
        plot_history(history.drop(columns="sd"))
