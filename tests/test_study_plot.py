"""probtrack study plot: one panel a metric, a line for each combination of what varies besides the axis."""

import re

import numpy as np
import pytest
from stored_studies import write_study

from probtrack.cli.main import main
from probtrack.evaluation import Store, pictures, plot_study

figures = pytest.importorskip("matplotlib.figure")

MAGIC = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path / "study.sqlite", vary={"num_particles": [25, 75, 500]})


@pytest.fixture
def drawn(monkeypatch):
    """Keeps the figures that are written."""
    kept = []
    save = figures.Figure.savefig
    monkeypatch.setattr(figures.Figure, "savefig", lambda self, *a, **k: (kept.append(self), save(self, *a, **k)))
    return kept


def plot(path, output, **choices):
    with Store(path) as store:
        return plot_study(store, output, **choices)


@pytest.mark.parametrize("suffix", MAGIC)
def test_picture_is_of_its_kind(study, tmp_path, suffix):
    output = tmp_path / f"p{suffix}"
    assert main(["study", "plot", str(study), "-o", str(output)]) == 0
    assert output.read_bytes().startswith(MAGIC[suffix])
    assert output.stat().st_size > 8000


def test_lines_and_bands_are_those_of_the_table(study, tmp_path, drawn):
    table = plot(study, tmp_path / "p.svg", rows=["tracker"], x="num_particles", over="runs")
    assert [list(column.values()) for column in table.columns] == [[25], [75], [500]]
    panels = drawn[0].axes
    assert [axis.get_ylabel() for axis in panels] == ["rmse [m]", "track_loss [%]"]
    assert [axis.get_xlabel() for axis in panels] == ["num_particles"] * 2
    lines = {line.get_label(): line for line in panels[0].lines if not line.get_label().startswith("_")}
    assert list(lines) == ["soft", "loud"]
    np.testing.assert_array_equal(lines["loud"].get_xdata(), [25, 75, 500])
    np.testing.assert_allclose(lines["loud"].get_ydata(), table.value[1, :, 0])
    band = panels[0].collections[1].get_paths()[0].vertices[:, 1]
    np.testing.assert_allclose([band.min(), band.max()], [table.low[1, :, 0].min(), table.high[1, :, 0].max()])


def test_axis_is_the_number_with_most_values_and_lines_are_the_rest(study, tmp_path, drawn):
    table = plot(study, tmp_path / "p.svg")
    assert list(table.columns[0]) == ["num_particles"]
    assert [list(row) for row in table.rows] == [["tracker", "snr_db"]] * 4
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == [
        "soft, SNR 5 dB", "soft, SNR 20 dB", "loud, SNR 5 dB", "loud, SNR 20 dB",
    ]  # fmt: skip
    styles = {(line.get_color(), line.get_linestyle()) for line in drawn[0].axes[0].lines if line.get_label()[0] != "_"}
    assert len(styles) == 4


def test_names_are_drawn_as_they_are(tmp_path, drawn):
    names = [r"$\frac$", "_one", "a$b", "plain"]
    path = write_study(tmp_path / "s.sqlite", trackers=names, metrics=[(r"$\x$", "m")], scores=[lambda *_: (1.0, 2.0)])
    plot(path, tmp_path / "p.svg", x="snr_db", rows=["tracker"])
    assert [entry.get_text() for entry in drawn[0].legends[0].get_texts()] == names
    assert drawn[0].axes[0].get_ylabel() == r"$\x$ [m]"
    averaged = write_study(tmp_path / "t.sqlite", trackers=names, vary={"hop": [1, 2]})
    plot(averaged, tmp_path / "q.svg", x="hop", rows=["snr_db"], metrics=["seconds"])
    assert r"averaged over tracker: $\frac$, _one" in drawn[1].get_supxlabel()


def test_unfinished_points_are_hollow_and_said(tmp_path, drawn, capsys):
    path = write_study(tmp_path / "s.sqlite", finished=4)  # b is done, c is not
    assert main(["study", "plot", str(path), "-o", str(tmp_path / "p.png")]) == 0
    assert capsys.readouterr().err == f"probtrack study: warning: {path}: 4 of 6 cells finished\n"
    hollow = [line for line in drawn[0].axes[0].lines if line.get_markerfacecolor() == "white"]
    assert [list(line.get_xdata()) for line in hollow] == [[5], [5]]
    assert "hollow: not all runs finished" in drawn[0].get_supxlabel()


def test_logarithmic_axis_and_costs(study, tmp_path, drawn):
    plot(study, tmp_path / "p.svg", x="num_particles", log_x=True, metrics=["seconds"])
    (axis,) = drawn[0].axes
    assert (axis.get_xscale(), axis.get_ylabel()) == ("log", "seconds [s]")


def test_more_panels_than_fit_in_a_row(tmp_path, drawn):
    metrics = [(f"m{i}", "") for i in range(5)]
    path = write_study(tmp_path / "s.sqlite", metrics=metrics, scores=[lambda *_: (1.0, 2.0)] * 5)
    plot(path, tmp_path / "p.svg")
    assert len(drawn[0].axes) == 5


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["-o", "p.jpg"], ["p.jpg", "a picture ends in .png, .pdf, .svg", ".jpg"]),
        (["-o", "no/p.png"], ["no/p.png", "cannot write there"]),
        ([], ["-o is needed"]),
        (["-o", "p.png", "--x", "tracker"], ["x: tracker is no number"]),
        (["-o", "p.png", "--x", "speed"], ["x: the study has no factor 'speed'", "tracker, num_particles"]),
        (["-o", "p.png", "--rows", "speed"], ["rows: the study has no factor 'speed'"]),
        (["-o", "p.png", "--x", "t60", "--rows", "t60"], ["t60 can be along"]),
    ],
)
def test_wrong_flags(study, tmp_path, monkeypatch, capsys, flags, words):
    monkeypatch.chdir(tmp_path)
    assert main(["study", "plot", str(study), *flags]) == 2
    said = capsys.readouterr().err
    assert re.fullmatch(r"probtrack study: error: .*\n", said)
    assert [word for word in words if word not in said] == []
    assert not (tmp_path / "p.png").exists()


def test_study_without_several_numbers_and_one_with_a_zero(tmp_path, capsys):
    plain = write_study(tmp_path / "s.sqlite", scenes={"a": {}, "b": {}})
    zero = write_study(tmp_path / "t.sqlite", vary={"sway": [0, 0.5, 2]})
    output = str(tmp_path / "p.png")
    assert main(["study", "plot", str(plain), "-o", output]) == 2
    assert main(["study", "plot", str(zero), "-o", output, "--log-x"]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.endswith("x: no factor of the study has several numbers: name one with --x")
    assert second.endswith("log_x: values of sway must be positive, got 0")


def test_missing_matplotlib_names_the_install_line(study, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    assert main(["study", "plot", str(study), "-o", str(tmp_path / "p.png")]) == 2
    assert "pip install 'probtrack[report]'" in capsys.readouterr().err
    assert pictures.SUFFIXES == (".png", ".pdf", ".svg")
