"""Tables of studies: what a figure is, of which runs, and how the table is laid out."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats
from stored_studies import RUNS, SCENES, rmse, save, write_study

from probtrack.errors import InputError
from probtrack.evaluation import CellScores, PlannedCell, PlannedScene, Store, tabulate
from probtrack.evaluation.rendering import notes
from probtrack.metrics import bootstrap_interval


def table(path, **choices):
    with Store(path) as store:
        return tabulate(store, **choices)


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path / "study.sqlite")


def fraction(tracker, scenes):
    """Numerators and denominators of the runs of scenes (S, R, 2)."""
    return np.array([[rmse({"tracker": tracker}, scene, run) for run in range(RUNS)] for scene in scenes])


def test_figure_is_the_ratio_of_sums(study):
    found = table(study)
    assert (found.rows, found.columns) == (
        [{"tracker": "soft"}, {"tracker": "loud"}],
        [{"snr_db": 5}, {"snr_db": 20}],
    )
    for i, tracker in enumerate(("soft", "loud")):
        for k, scenes in enumerate((["b", "c"], ["a"])):
            above, below = fraction(tracker, scenes).sum((0, 1))
            np.testing.assert_allclose(found.value[i, k, 0], above / below, rtol=1e-14)


def test_share_is_in_percent(study):
    found = table(study)
    np.testing.assert_allclose(found.value[:, :, 1], [[25, 25], [0, 0]])
    assert found.high[0, 0, 1] > 1


@pytest.mark.parametrize(("over", "draws"), [("scenes", 3), ("runs", 12)])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_share_of_none_or_all_has_the_exact_interval_of_as_many_draws(tmp_path, over, draws, share):
    scores = (lambda *_: (7.0 * share, 7.0),) * 2
    path = write_study(tmp_path / "s.sqlite", scores=scores, metrics=[("track_loss", "%"), ("rmse", "m")])
    found = table(path, rows=["tracker"], columns=[], over=over, level=0.9)
    shown = int(share * draws)
    exact = stats.binomtest(shown, draws).proportion_ci(0.9, method="exact")
    np.testing.assert_allclose(found.low[:, 0, 0], 100 * exact.low, rtol=1e-12)
    np.testing.assert_allclose(found.high[:, 0, 0], 100 * exact.high, rtol=1e-12)
    np.testing.assert_array_equal(found.low[..., 1], share)  # no share: metres may be alike
    assert any("Clopper-Pearson" in note and over in note for note in notes(found))


def test_runs_without_anything_to_judge_are_no_draws_of_a_share(tmp_path):
    scores = (lambda _settings, _scene, run: (0.0, float(run < 3)),)
    path = write_study(tmp_path / "s.sqlite", scores=scores, metrics=[("track_loss", "%")])
    found = table(path, rows=["tracker"], columns=[], over="runs")
    np.testing.assert_allclose(found.high, 100 * stats.binomtest(0, 9).proportion_ci(0.95, method="exact").high)


def test_share_between_has_no_exact_interval(study):
    found = table(study, rows=["tracker"], columns=[], metrics=["track_loss"], over="runs")
    assert (found.value[0], found.low[0]) == (25, 0)
    assert found.high[0] < 60
    assert _said(found) == 1
    assert _said(table(study, metrics=["rmse"])) == 0


def _said(found):
    return sum("Clopper-Pearson" in note for note in notes(found))


@pytest.mark.parametrize("over", ["scenes", "runs"])
def test_interval_is_the_bootstrap_of_the_group_and_nan_without_two_scenes(study, over):
    found = table(study, over=over, level=0.8)
    runs = fraction("loud", ["b", "c"])
    low, high = bootstrap_interval(runs[..., 0], runs[..., 1], over=over, level=0.8)
    np.testing.assert_allclose([found.low[1, 0, 0], found.high[1, 0, 0]], [low, high], rtol=1e-12)
    assert low < found.value[1, 0, 0] < high
    assert np.isnan(found.low[1, 1, 0]) == (over == "scenes")


def test_wider_level_wider_interval(study):
    narrow, wide = table(study, level=0.5, over="runs"), table(study, level=0.99, over="runs")
    assert (wide.high - wide.low)[0, 0, 0] > 1.5 * (narrow.high - narrow.low)[0, 0, 0]


def test_cells_that_are_put_together_are_not_mixed_when_runs_are_drawn(tmp_path):
    """Settings far apart, without any chance within: drawing runs anew changes nothing."""
    scores = (lambda settings, *_: (float(settings["num_particles"]), 1.0),)
    vary = {"num_particles": [25, 75]}
    path = write_study(tmp_path / "s.sqlite", vary=vary, scores=scores, metrics=[("rmse", "m")])
    found = table(path, rows=["tracker"], columns=[], over="runs")
    np.testing.assert_allclose([found.value, found.low, found.high], 50)
    assert found.averaged == {"num_particles": [25, 75], "snr_db": [5, 20]}


def test_what_a_run_takes(study):
    found = table(study, metrics=["real_time_factor", "seconds"])
    np.testing.assert_allclose(found.value, np.broadcast_to([0.25, 0.5], (2, 2, 2)))
    assert np.isnan(found.low).all()


def test_what_a_run_takes_is_of_finished_runs(tmp_path):
    path = write_study(tmp_path / "s.sqlite", finished=3)
    found = table(path, metrics=["seconds", "real_time_factor"])
    np.testing.assert_allclose(found.value[0], [[0.5, 0.25]] * 2)
    assert np.isnan(found.value[1, 0]).all()


def test_run_without_anything_to_judge_does_not_count(tmp_path):
    scores = (lambda _settings, _scene, run: (0.0, 0.0) if run == 1 else (run * 2.0, 2.0),)
    path = write_study(tmp_path / "s.sqlite", metrics=[("rmse", "m")], scores=scores)
    np.testing.assert_allclose(table(path).value, (0 + 2 + 3) / 3)


def test_group_with_nothing_to_judge_has_no_figure(tmp_path):
    path = write_study(tmp_path / "s.sqlite", metrics=[("rmse", "m")], scores=(lambda *_: (0.0, 0.0),))
    found = table(path)
    assert np.isnan([found.value, found.low, found.high]).all()


@pytest.mark.parametrize(
    ("choices", "rows", "columns"),
    [
        ({}, ["tracker", "num_particles"], ["snr_db"]),
        ({"rows": ["tracker"]}, ["tracker"], ["num_particles", "snr_db"]),
        ({"columns": ["num_particles"]}, ["tracker", "snr_db"], ["num_particles"]),
        ({"rows": ["scene"]}, ["scene"], ["tracker", "num_particles"]),
        ({"rows": ["tracker"], "columns": []}, ["tracker"], []),
        ({"rows": ["t60"], "columns": ["scene", "tracker"]}, ["t60"], ["scene", "tracker"]),
    ],
)
def test_layout(tmp_path, choices, rows, columns):
    found = table(write_study(tmp_path / "s.sqlite", vary={"num_particles": [75, 25]}), **choices)
    assert (list(found.rows[0]), list(found.columns[0])) == (rows, columns)
    assert (found.planned.sum(), found.runs.sum()) == (48, 48)


def test_numbers_are_in_order_and_names_as_they_come(tmp_path):
    found = table(write_study(tmp_path / "s.sqlite", vary={"num_particles": [75, 9, 300]}))
    assert [tuple(row.values()) for row in found.rows[:4]] == [("soft", 9), ("soft", 75), ("soft", 300), ("loud", 9)]
    assert found.fixed == {"t60": 0.27}


def test_cells_without_a_factor_are_a_group_of_their_own(tmp_path):
    scenes = {"a": {"snr_db": 20}, "b": {}, "c": {"snr_db": 5}}
    found = table(write_study(tmp_path / "s.sqlite", scenes=scenes))
    assert found.columns == [{"snr_db": 5}, {"snr_db": 20}, {"snr_db": None}]
    np.testing.assert_allclose(found.value[0, :, 0], fraction("soft", "cab").sum(1)[:, 0] / [240, 40, 80])


def test_one_tracker_on_one_scene(tmp_path):
    path = write_study(tmp_path / "s.sqlite", trackers=["only"], scenes={"hall": {}})
    found = table(path)
    assert (found.rows, found.columns, found.value.shape) == ([{"tracker": "only"}], [{}], (1, 1, 2))


def test_unfinished_study_shows_what_there_is(tmp_path):
    found = table(write_study(tmp_path / "s.sqlite", finished=3, failure="no microphones"))
    np.testing.assert_array_equal(found.runs, [[4, 4], [0, 4]])
    np.testing.assert_array_equal(found.planned, [[8, 4], [8, 4]])
    np.testing.assert_array_equal(found.scenes, [[1, 1], [0, 1]])
    assert np.isnan(found.value[1, 0]).all()
    above, below = fraction("soft", "b").sum((0, 1))
    np.testing.assert_allclose(found.value[0, 0, 0], above / below)
    assert str(found.progress) == "3 of 6 cells finished, 1 failed, the first: no microphones"


def test_two_readers_see_whole_cells_while_another_writes(tmp_path):
    path = write_study(tmp_path / "s.sqlite", finished=2)
    with Store(path) as first, Store(path) as second, Store(path, write=True) as writer:
        seen = []
        for number, (scene, tracker) in enumerate([("b", "soft"), ("b", "loud"), ("c", "soft")], start=3):
            save(writer, number, {"tracker": tracker}, scene)
            seen += [int(tabulate(reader).runs.sum()) for reader in (first, second)]
    assert seen == [12, 12, 16, 16, 20, 20]


def test_cell_finished_after_the_others_were_listed_does_not_count(tmp_path, monkeypatch):
    path = write_study(tmp_path / "s.sqlite", finished=1)
    with Store(path) as store:
        before = tabulate(store)
        cells = store.cells
        with Store(path, write=True) as writer:
            save(writer, 2, {"tracker": "loud"}, "a")
        monkeypatch.setattr(Store, "cells", cells)
        np.testing.assert_array_equal(tabulate(store).value, before.value)


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"metrics": ["rms"]}, ["no metric 'rms'", "rmse, track_loss, seconds, real_time_factor"]),
        ({"rows": ["model"]}, ["rows", "no factor 'model'", "tracker, snr_db, t60, scene"]),
        ({"columns": ["model"]}, ["columns", "no factor 'model'"]),
        ({"rows": ["scene"], "columns": ["scene"]}, ["scene can be along rows or along columns"]),
        ({"level": 1.0}, ["level must lie between 0 and 1, got 1"]),
        ({"level": float("nan")}, ["level must lie between 0 and 1, got nan"]),
    ],
)
def test_wrong_choice_is_said(study, choices, words):
    with pytest.raises(InputError) as error:
        table(study, **choices)
    assert all(word in str(error.value) for word in words)


def test_nothing_finished_is_said(tmp_path):
    path = write_study(tmp_path / "s.sqlite", finished=0, failure="no such voice")
    with pytest.raises(InputError, match=r"nothing to show yet: 0 of 6 cells finished, 1 failed, .* no such voice"):
        table(path)


def test_scenes_of_a_group_are_counted_once(tmp_path):
    found = table(write_study(tmp_path / "s.sqlite"), rows=["t60"], columns=[])
    assert found.scenes.tolist() == [[len(SCENES)]]


def test_reading_does_without_torch():
    code = "import sys, probtrack.cli.study, probtrack.evaluation.rendering as r; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_recordings_of_one_scene_are_one_draw_of_a_scene(tmp_path):
    scenes = [
        PlannedScene(f"{way}_{snr}dB", f"{way}{snr}", {"snr_db": snr}, range(3), origin=f"way {way}")
        for way in range(4)
        for snr in (5, 20)
    ]
    cells = [PlannedCell(f"a on {one.name}", one.name, {"tracker": "a"}, 3) for one in scenes]
    with Store.create(tmp_path / "s.sqlite", {}, scenes, [("rmse", "m")], cells) as store:
        for number in range(8):
            value = np.full((1, 3), float(number // 2))
            store.save(number + 1, CellScores(value, np.ones((1, 3)), 1.0, 8.0))
        made = tabulate(store, columns=[], rows=["tracker"])
    # eight recordings of four ways say no more than four
    alone = bootstrap_interval(np.arange(4.0)[:, None], np.ones((4, 1)), over="scenes")
    assert made.scenes.item() == 4
    assert made.low.item() == pytest.approx(alone.low)
    assert made.high.item() == pytest.approx(alone.high)
    assert made.averaged == {"snr_db": [5, 20]}
