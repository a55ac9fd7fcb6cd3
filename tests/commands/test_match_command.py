"""`match`: a file and a line for every pair, whatever happens to the others."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import contents, fail, run

from torchcrf_scan import JointScanCRF, PairPrediction, ScanPair
from torchcrf_scan.commands import match as match_command
from torchcrf_scan.commands.arguments import PairPlace
from torchcrf_scan.commands.match import describe, mover_speeds
from torchcrf_scan.data.carmen import CarmenLog
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_pair, read_prediction


def test_match_writes_what_the_model_says(pairs_dir: Path, predictions_dir: Path, model_dir: Path) -> None:
    pairs = PairFiles(pairs_dir)
    assert sorted(path.name for path in predictions_dir.iterdir()) == [path.name for path in pairs.paths]
    for pair, expected in zip(pairs, JointScanCRF.from_pretrained(model_dir).match_pairs(list(pairs)), strict=True):
        found = read_prediction(predictions_dir / f"{pair.name}.npz")
        assert (found.association == expected.association).all()
        assert (found.cluster == expected.cluster).all()
        assert np.allclose(found.motions, expected.motions, atol=1e-6)


def test_match_takes_files_and_patterns_once_each(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_spelling = pairs_dir / ".." / pairs_dir.name / "sim_s0_000.npz"
    files = [pairs_dir / "sim_s0_000.npz", other_spelling, f"{pairs_dir}/*s1_001.npz"]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir, "--candidates=4") == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out[:-1]] == ["sim_s0_000", "sim_s1_001"]
    assert "sensor" in out[0]
    assert out[-1].startswith("2 of 2 pairs matched, something moving in ")
    assert out[-1].endswith(f"; predictions in {tmp_path}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sim_s0_000.npz", "sim_s1_001.npz"]


def test_match_refuses_two_files_of_one_name(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "sim_s0_000.npz"
    copy.write_bytes((pairs_dir / copy.name).read_bytes())
    message = fail(capsys, "match", pairs_dir, copy, "--output", tmp_path / "out")
    assert str(copy) in message
    assert not (tmp_path / "out").exists()


def test_match_never_replaces_a_pair(pairs_dir: Path, model_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(pairs_dir)
    assert "nothing but predictions" in fail(capsys, "match", pairs_dir, "--output", pairs_dir, "--model", model_dir)
    assert contents(pairs_dir) == before


def test_match_again_replaces_predictions(pairs_dir: Path, model_dir: Path, tmp_path: Path) -> None:
    for candidates in (1, 8):
        options = ["--output", tmp_path, "--model", model_dir, f"--candidates={candidates}"]
        assert run("match", pairs_dir / "sim_s0_000.npz", *options) == 0
    pair = read_pair(pairs_dir / "sim_s0_000.npz")
    expected = JointScanCRF.from_pretrained(model_dir).match_pairs([pair])[0]
    assert (read_prediction(tmp_path / "sim_s0_000.npz").association == expected.association).all()


def test_broken_files_do_not_lose_the_others(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken, empty = tmp_path / "a_broken.npz", tmp_path / "z_empty.npz"
    broken.write_bytes((pairs_dir / "sim_s0_000.npz").read_bytes()[:300])
    empty.touch()
    assert run("match", broken, pairs_dir / "sim_s0_000.npz", empty, "--output", tmp_path / "out", "--model", model_dir) == 1
    out, err = capsys.readouterr()
    assert "1 of 2 pairs matched" in out  # what is empty may have been a log
    assert [str(path) in line for path, line in zip((empty, broken), err.splitlines(), strict=True)] == [True, True]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["sim_s0_000.npz"]


def test_a_malformed_line_of_a_log_is_left_out(
    log_file: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = gzip.decompress(log_file.read_bytes()).decode().splitlines(keepends=True)
    log = tmp_path / "room.log"
    log.write_text("".join([*lines[:2], "FLASER 60 1 two 3\n", *lines[2:]]))
    assert run("match", log, "--output", tmp_path / "out", "--model", model_dir) == 0
    out, err = capsys.readouterr()
    assert "4 of 4 pairs matched" in out
    assert f"; 1 scan or message left out, because of {log}, line 3 (byte " in out
    assert err == ""
    assert run("plot", log, "--number=3", "--output", tmp_path / "a.png") == 0
    assert "; 1 scan or message left out, " in capsys.readouterr().out


def test_a_pair_that_the_model_cannot_take_does_not_lose_the_others(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = JointScanCRF.match_pairs

    def picky(model: JointScanCRF, pairs: list[ScanPair]) -> list[PairPrediction]:
        if any(pair.name == "sim_s0_001" for pair in pairs):
            raise RuntimeError("too large")
        return whole(model, pairs)

    monkeypatch.setattr(JointScanCRF, "match_pairs", picky)
    files = [pairs_dir / f"sim_s0_00{i}.npz" for i in (0, 1)]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir) == 1
    assert f"{files[1]}: too large" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sim_s0_000.npz"]


def test_match_takes_every_pair_of_a_log(
    log_file: Path, pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [log_file, pairs_dir / "sim_s0_000.npz", log_file.parent / ".." / log_file.parent.name / "*.log.gz"]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir) == 0
    names = ["room_00000", "room_00001", "room_00002", "room_00003", "sim_s0_000"]
    assert sorted(line.split(":")[0] for line in capsys.readouterr().out.splitlines()[:-1]) == names
    assert sorted(path.stem for path in tmp_path.iterdir()) == names
    expected = JointScanCRF.from_pretrained(model_dir).match_pairs(list(CarmenLog(log_file)))[2]
    found = read_prediction(tmp_path / "room_00002.npz")
    assert len(found.association) == 60
    assert (found.association == expected.association).all()
    assert np.allclose(found.motions, expected.motions, atol=1e-6)


def test_match_takes_some_pairs_of_a_log(log_file: Path, pairs_dir: Path, model_dir: Path, tmp_path: Path) -> None:
    files = [log_file, *(pairs_dir / f"sim_s0_00{i}.npz" for i in (0, 1))]
    assert run("match", *files, "--every=3", "--output", tmp_path, "--model", model_dir) == 0
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["room_00000", "room_00003", "sim_s0_000", "sim_s0_001"]


def test_match_makes_the_pairs_of_a_log_when_their_turn_comes(
    log_file: Path, model_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    sizes: list[int] = []

    def make(place: PairPlace) -> ScanPair:
        made.append(place.number)
        return CarmenLog(place.path)[place.number]

    def match_none(model: JointScanCRF, pairs: list[ScanPair]) -> list[PairPrediction]:
        sizes.append(len(made))
        raise ValueError("not today")

    monkeypatch.setattr(match_command, "BATCH", 2)
    monkeypatch.setattr(PairPlace, "read", make)
    monkeypatch.setattr(JointScanCRF, "match_pairs", match_none)
    assert run("match", log_file, "--output", tmp_path, "--model", model_dir) == 1
    assert sizes == [2, 2, 2, 4, 4, 4]  # a batch, then its pairs alone


def test_a_summary_ends_the_output(
    log_file: Path,
    model_dir: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def one_mover(model: JointScanCRF, pairs: list[ScanPair]) -> list[PairPrediction]:
        labels = [np.where(np.arange(60) < 6 * (pair.name == "room_00001"), 1, 0) for pair in pairs]
        return [PairPrediction(label, label, np.zeros((1 + label.max(), 3)), np.ones(60), np.ones(60), True) for label in labels]

    monkeypatch.setattr(JointScanCRF, "match_pairs", one_mover)
    assert run("match", log_file, "--output", tmp_path, "--model", model_dir) == 0
    share = 100 * 6 / (4 * 59)  # a beam returns nothing
    expected = (
        f"4 of 4 pairs matched, something moving in 25.0 % of them, {share:.2f} % of their source points; predictions in {tmp_path}"
    )
    assert capsys.readouterr().out.splitlines()[-1] == expected


def test_a_broken_log_does_not_lose_the_others(
    log_file: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken, short = tmp_path / "broken.log", tmp_path / "short.log"
    lines = gzip.decompress(log_file.read_bytes()).decode().splitlines()
    short.write_text(lines[0])
    broken.write_text(f"{lines[0]}\nFLASER 3 1 2\n")
    assert run("match", broken, short, log_file, "--every=2", "--output", tmp_path / "out", "--model", model_dir) == 1
    out, err = capsys.readouterr()
    assert "2 of 2 pairs matched" in out
    assert f"; 1 scan or message left out, because of {broken}, line 2 (byte {len(lines[0]) + 1}): expected" in out
    for path, line in zip((broken, short), err.splitlines(), strict=True):
        assert f"{path}: expected at least two" in line
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_a_cut_log_gives_its_whole_pairs(
    log_file: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = gzip.decompress(log_file.read_bytes()).decode()
    (tmp_path / "cut.txt").write_text(text[:-100])
    assert run("match", tmp_path / "cut.txt", "--output", tmp_path / "out", "--model", model_dir) == 1
    out, err = capsys.readouterr()
    assert "3 of 3 pairs matched" in out
    assert "line 5" in err.splitlines()[-1]


def test_match_reads_bags(
    log_file: Path, pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros`)")
    from bags import drive, write

    bag = write(tmp_path, "mcap", [*drive(3, "/front"), *drive(3, "/rear")])
    options = ["--output", tmp_path / "out", "--model", model_dir]
    assert run("match", bag, "--topic", "/front", *options) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["mcap_00000.npz", "mcap_00001.npz"]
    capsys.readouterr()
    assert run("match", bag, *options) == 1
    assert "topic: expected which of /front (sensor_msgs/LaserScan), /rear" in capsys.readouterr().err
    message = fail(capsys, "match", pairs_dir, "--topic", "/front", *options)
    assert "--topic, --odometry, --no_return: expected a log to read with them, got pair files alone" in message


def test_match_refuses_two_pairs_of_one_name(
    log_file: Path, pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair, log = tmp_path / "room_00001.npz", tmp_path / "room.log"
    pair.write_bytes((pairs_dir / "sim_s0_000.npz").read_bytes())
    log.write_bytes(gzip.decompress(log_file.read_bytes()))
    for other, name in ((pair, "pair 1"), (log, "pair 0")):
        message = fail(capsys, "match", log_file, other, "--output", tmp_path / "out", "--model", model_dir)
        assert "expected pair names that differ" in message
        assert str(other) in message
        assert f"{log_file}, {name}" in message
    assert not (tmp_path / "out").exists()
    assert run("match", log_file, pair, "--every=2", "--output", tmp_path / "out", "--model", model_dir) == 0


def test_match_on_a_real_log(real_logs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("match", real_logs_dir / "fhw-corrected.log.gz", "--every=300", "--output", tmp_path) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("2 of 2 pairs matched")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fhw-corrected_00000.npz", "fhw-corrected_00300.npz"]


def test_match_names_the_bad_argument(pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def message(*options: object) -> str:
        return fail(capsys, "match", pairs_dir, "--output", tmp_path / "out", *options)

    assert "nowhere" in fail(capsys, "match", tmp_path / "nowhere", "--output", tmp_path / "out")
    assert "--model no_such_model" in message("--model", "no_such_model")
    assert "--threads: expected at least 1" in message("--model", model_dir, "--threads=0")
    assert "candidates: expected a whole number in [0, 256], got -1" in message("--model", model_dir, "--candidates=-1")
    assert "--device: expected" in message("--model", model_dir, "--device=abacus")
    assert "--every: expected at least 1" in message("--every=0")
    assert "--every: expected a log" in message("--every=2")
    assert not (tmp_path / "out").exists()


def test_speeds_are_over_ground(moving_pair: tuple[ScanPair, PairPrediction]) -> None:
    pair, prediction = moving_pair
    assert mover_speeds(pair, prediction) == pytest.approx([2.0])


def test_a_pair_is_described_in_one_line(moving_pair: tuple[ScanPair, PairPrediction]) -> None:
    pair, prediction = moving_pair
    moving = "corner: sensor +1.00 m ahead, +0.00 m left, +90.0 deg; 1 moving: 2.00 m/s (2 points); 0 of 4 points outliers"
    assert describe(pair, prediction) == moving
    lost = np.full(5, -1)
    still = replace(prediction, association=lost, cluster=lost, motions=np.zeros((1, 3)), converged=False)
    expected = "corner: sensor +0.00 m ahead, +0.00 m left, +0.0 deg; nothing moving; 4 of 4 points outliers; not converged"
    assert describe(pair, still) == expected


@pytest.mark.parametrize(
    ("turn", "shift", "said"),
    [
        (False, (0.0, 0.0), ""),
        (False, (0.98, 0.2), "; sliding along (0.98, 0.20) not observed"),
        (False, (-0.98, 0.2), "; sliding along (0.98, -0.20) not observed"),
        (False, (0.0, -1.0), "; sliding along (0.00, 1.00) not observed"),
        (True, (0.0, 0.0), "; turn not observed"),
        (True, (1.0, -0.001), "; turn not observed; sliding along (1.00, 0.00) not observed"),
    ],
)
def test_a_background_that_may_have_slid_is_told(
    moving_pair: tuple[ScanPair, PairPrediction], turn: bool, shift: tuple[float, float], said: str
) -> None:
    """Of the background alone; a direction is told either way round."""
    pair, prediction = moving_pair
    bare = describe(pair, prediction)
    given = replace(
        prediction,
        covariances=np.tile(np.eye(3), (2, 1, 1)),
        unobserved_turn=np.array([turn, True]),
        unobserved_shift=np.array([shift, (1.0, 0.0)]),
    )
    assert describe(pair, given) == bare + said
    assert describe(pair, replace(given, converged=False)) == bare + said + "; not converged"
