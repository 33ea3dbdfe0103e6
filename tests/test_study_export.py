"""Runs of studies as tables of pandas, and what is left of a damaged store."""

import re
import sqlite3

import numpy as np
import pytest
from stored_studies import rmse, write_study

from probtrack.cli.main import main
from probtrack.evaluation import Store, runs_table

pandas = pytest.importorskip("pandas")
pytest.importorskip("pyarrow")


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path / "study.sqlite", vary={"num_particles": [25, 75]})


def table(path):
    with Store(path) as store:
        return runs_table(store)


def export(capsys, path, output):
    """Return the table that is written, and the warning."""
    assert main(["study", "export", str(path), "-o", str(output)]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    return pandas.read_parquet(output) if output.suffix == ".parquet" else pandas.read_csv(output), said.err


def test_one_row_a_run_with_all_factors(study):
    found = table(study)
    assert list(found) == ["tracker", "num_particles", "snr_db", "t60", "scene", "run", "seed", "rmse", "track_loss"]
    assert len(found) == 3 * 4 * 4
    one = found[(found.tracker == "loud") & (found.scene == "b") & (found.num_particles == 75) & (found.run == 2)]
    above, below = rmse({"tracker": "loud"}, "b", 2)
    assert one.drop(columns="rmse").to_dict("records") == [
        {"tracker": "loud", "num_particles": 75, "snr_db": 5, "t60": 0.27, "scene": "b", "run": 2, "seed": 102,
         "track_loss": 0},
    ]  # fmt: skip
    np.testing.assert_allclose(one.rmse, above / below, rtol=1e-15)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".CSV"])
def test_file_has_the_table(study, tmp_path, capsys, suffix):
    found, warning = export(capsys, study, tmp_path / f"runs{suffix}")
    pandas.testing.assert_frame_equal(found, table(study), check_dtype=False, rtol=1e-15)
    assert warning == ""


def test_undefined_runs_are_empty(tmp_path):
    scores = (lambda _settings, _scene, run: (0.0, float(run != 1)), rmse)
    path = write_study(tmp_path / "s.sqlite", scores=scores)
    found = table(path)
    assert found.rmse.isna().equals(found.run == 1)


def test_seeds_of_56_bits_are_exact(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", first_seed=2**56 - 5)
    found, _ = export(capsys, path, tmp_path / "r.csv")
    assert found.seed[:4].tolist() == [2**56 - 5, 2**56 - 4, 2**56 - 3, 2**56 - 2]


def test_factors_of_mixed_kind_are_text_and_missing_numbers_empty(tmp_path, capsys):
    path = write_study(
        tmp_path / "s.sqlite",
        vary={"height": [1.5, "free"], "vad": [True, False]},
        scenes={"a": {"snr_db": 5}, "b": {}},
    )
    for suffix in (".csv", ".parquet"):
        found, _ = export(capsys, path, tmp_path / f"r{suffix}")
        assert set(found.height) == {"1.5", "free"}
        assert set(found.vad) == {True, False}
        assert found.snr_db[found.scene == "b"].isna().all()


def test_unfinished_study_gives_its_finished_runs(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", finished=3)
    found, warning = export(capsys, path, tmp_path / "r.csv")
    assert (len(found), warning) == (12, "")
    path = write_study(tmp_path / "t.sqlite", finished=0)
    found, _ = export(capsys, path, tmp_path / "r.csv")
    assert len(found) == 0
    assert "rmse" in found


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A store of many pages, and its table."""
    path = tmp_path_factory.mktemp("large") / "study.sqlite"
    scenes = {f"s{i}": {"snr_db": i % 3} for i in range(20)}
    write_study(path, scenes=scenes, runs=60, vary={"num_particles": [25, 75, 300]})
    return path.read_bytes(), table(path)


def bits_flipped(content):
    generator = np.random.default_rng(4)
    changed = np.frombuffer(content, np.uint8).copy()
    changed[generator.integers(40_000, len(content), 50)] ^= 4
    return changed.tobytes()


def pages_overwritten(content):
    middle = len(content) // 2
    return content[:middle] + np.random.default_rng(5).bytes(9000) + content[middle + 9000 :]


def cut_off(content):
    return content[: len(content) * 3 // 5]


@pytest.mark.parametrize("damage", [bits_flipped, pages_overwritten, cut_off])
def test_damaged_store_gives_up_whole_cells_and_no_changed_number(large, tmp_path, capsys, damage):
    content, whole = large
    path = tmp_path / "s.sqlite"
    path.write_bytes(damage(content))
    assert main(["study", "show", str(path)]) == 2
    assert "probtrack study export" in capsys.readouterr().err
    found, warning = export(capsys, path, tmp_path / "r.parquet")
    cells = len(found) // 60
    assert 40 < cells < 120
    begin = (
        f"probtrack study: warning: {path} is damaged: got {cells} of 120 cells, {60 * cells} runs; left behind are "
    )
    assert warning.startswith(begin)
    assert sum(map(int, re.findall(r"(\d+) (?:whose scores|of which)", warning))) == 120 - cells
    keys = ["tracker", "num_particles", "scene", "run"]
    kept = whole.merge(found[keys], on=keys)
    assert len(kept) == len(found)
    found, kept = (part.sort_values(keys, ignore_index=True) for part in (found, kept))
    pandas.testing.assert_frame_equal(found, kept)


def test_score_that_has_changed_is_not_read(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("UPDATE score SET numerator = denominator WHERE metric = 1 AND cell = 5")
        db.execute("UPDATE score SET cell = 99 WHERE metric = 2 AND cell = 7")
    db.close()
    found, warning = export(capsys, study, tmp_path / "r.csv")
    assert len(found) == 40
    assert "got 10 of 12 cells, 40 runs; left behind are 2 whose scores are damaged" in warning


def test_cells_whose_scores_are_missing_are_left_behind(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("DELETE FROM score WHERE metric = 2 AND cell = 5")
    db.close()
    found, warning = export(capsys, study, tmp_path / "r.csv")
    assert len(found) == 44
    assert "got 11 of 12 cells, 44 runs; left behind are 1 whose scores are damaged" in warning


def test_what_else_is_unreadable_is_left_empty_or_behind(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("UPDATE cell SET settings = '{\"tracker' WHERE id = 2")
        db.execute("UPDATE scene SET conditions = '{' WHERE name = 'a'")
        db.execute("DELETE FROM seed WHERE scene = 'b' AND run = 1")
        db.execute("UPDATE cell SET settings = replace(settings, '75', '25') WHERE id = 8")
    db.close()
    found, warning = export(capsys, study, tmp_path / "r.csv")
    assert "got 10 of 12 cells, 40 runs; left behind are 2 of which it is not known what they are" in warning
    assert "; empty are conditions of 1 recordings and seeds of 1 recordings\n" in warning
    assert found.snr_db.isna().equals(found.scene == "a")
    assert found.seed.isna().equals(found.scene == "b")


def test_names_of_metrics_that_may_have_changed_are_said(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("UPDATE metric SET name = 'rmsd' WHERE id = 1")
    db.close()
    found, warning = export(capsys, study, tmp_path / "r.csv")
    assert len(found) == 48
    assert warning.endswith("; the names of metrics may not be what they were\n")


def test_scores_of_a_cell_that_no_longer_says_it_is_finished_are_kept(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("UPDATE cell SET finished = NULL WHERE id = 3")
        db.execute("UPDATE cell SET seconds = 9.0 WHERE id = 4")
    db.close()
    found, warning = export(capsys, study, tmp_path / "r.csv")
    assert len(found) == 48
    assert "got 12 of 12 cells" in warning


def test_damaged_store_without_a_whole_cell_is_an_error_and_no_table(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("UPDATE score SET numerator = zeroblob(32)")
    db.close()
    assert main(["study", "export", str(study), "-o", str(tmp_path / "r.csv")]) == 2
    assert capsys.readouterr().err == f"probtrack study: error: {study}: is damaged, and no cell of it is whole\n"
    assert not (tmp_path / "r.csv").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such study"),
        (b"", "not a study made by probtrack evaluate"),
        (b"time,x,y\n" * 99, "nothing can be read of it: file is not a database"),
        (b"SQLite format 3\0" + bytes(5000), "nothing can be read of it"),
    ],
)
def test_file_of_which_nothing_can_be_read(tmp_path, capsys, content, words):
    path, output = tmp_path / "s.sqlite", tmp_path / "r.csv"
    if content is not None:
        path.write_bytes(content)
    assert main(["study", "export", str(path), "-o", str(output)]) == 2
    said = capsys.readouterr().err
    assert re.fullmatch(rf"probtrack study: error: {path}.*{words}.*\n", said)
    assert not output.exists()


def test_store_of_another_format(study, tmp_path, capsys):
    with sqlite3.connect(study) as db:
        db.execute("UPDATE meta SET value = '7' WHERE key = 'format'")
    db.close()
    assert main(["study", "export", str(study), "-o", str(tmp_path / "r.csv")]) == 2
    assert "a study of format 7" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("output", "words"), [("r.xlsx", "a table of runs ends in .csv, .parquet"), ("no/r.csv", "cannot write there")]
)
def test_output_that_cannot_be(study, tmp_path, capsys, output, words):
    assert main(["study", "export", str(study), "-o", str(tmp_path / output)]) == 2
    assert words in capsys.readouterr().err
    assert main(["study", "export", str(study)]) == 2
    assert "-o is needed" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["pandas", "pyarrow"])
def test_missing_library_names_the_install_line(study, tmp_path, monkeypatch, capsys, module):
    monkeypatch.setitem(__import__("sys").modules, module, None)
    assert main(["study", "export", str(study), "-o", str(tmp_path / "r.parquet")]) == 2
    assert "pip install 'probtrack[report]'" in capsys.readouterr().err
