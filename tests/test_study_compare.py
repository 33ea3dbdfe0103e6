"""Differences of studies: which runs are partners, what is said of the difference, and when nothing can be."""

import json
import re

import numpy as np
import pytest
from stored_studies import SCENES, write_study

from probtrack.cli.main import main
from probtrack.errors import InputError
from probtrack.evaluation import Side, Store, compare, comparison
from probtrack.evaluation.comparison import holm
from probtrack.evaluation.comparison_rendering import comparison_notes
from probtrack.metrics import paired_difference

MANY = {f"s{i}": {"snr_db": 5 * (i % 2), "t60": 0.27} for i in range(7)}
ONE = [("rmse", "m")]


def level(settings, scene, run):
    """A chance part that both trackers share, and a difference that is 0.1 + 0.01 i on scene i."""
    number = int(scene[1:])
    shared = np.sin(97.0 * number + 31.0 * run)
    return 3 * (shared + (0.1 + 0.01 * number + 0.001 * run) * (settings["tracker"] == "soft")), 3.0


def compared(first, second=None, *, a=(), b=(), **choices):
    with Store(first) as one, Store(second or first) as other:
        return compare(Side(one, a, "--a"), Side(other, b, "--b"), **choices)


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path / "s.sqlite", scenes=MANY, metrics=ONE, scores=[level])


def parts(path, **choices):
    return compared(path, a=["tracker=soft"], b=["tracker=loud"], **choices)


@pytest.mark.parametrize("over", ["scenes", "runs"])
def test_difference_of_partners_is_free_of_the_chance_they_share(study, over):
    found = parts(study, over=over, level=0.9)
    np.testing.assert_allclose(found.difference, [[0.1 + 0.03 + 0.0015]])
    np.testing.assert_allclose(found.first - found.second, found.difference)
    sides = [[[np.divide(*level({"tracker": t}, s, r)) for r in range(4)] for s in MANY] for t in ("soft", "loud")]
    expected = paired_difference(*sides, over=over, level=0.9)
    np.testing.assert_allclose([found.low[0, 0], found.high[0, 0]], [expected.low, expected.high], rtol=1e-9)
    np.testing.assert_allclose(found.p_value[0, 0], expected.p_value)
    assert found.low[0, 0] < 0.1315 < found.high[0, 0]
    assert (found.pairs.item(), found.scenes.item(), found.alone) == (28, 7, (0, 0))


def test_seven_scenes_of_one_sign_have_the_smallest_p_value(study):
    np.testing.assert_allclose(parts(study).p_value, 2.0**-6)


def test_other_way_round_other_sign(study):
    there, back = parts(study), compared(study, a=["tracker=loud"], b=["tracker=soft"])
    np.testing.assert_allclose(back.difference, -there.difference)
    np.testing.assert_allclose([back.low, back.high], [-there.high, -there.low], rtol=0.05)


def test_rows_by_factor_and_holm(study):
    found = parts(study, by=["snr_db"])
    assert found.rows == [{"snr_db": 0}, {"snr_db": 5}]
    np.testing.assert_allclose(found.difference[:, 0], [0.1015 + 0.03, 0.1015 + 0.03])
    np.testing.assert_allclose(found.p_value[:, 0], [2.0**-3, 2.0**-2])
    np.testing.assert_allclose(found.adjusted[:, 0], [2.0**-2, 2.0**-2])
    assert found.pairs[:, 0].tolist() == [16, 12]


def test_holm_by_hand():
    np.testing.assert_allclose(holm(np.array([[0.01, 0.5], [0.02, 0.9]])), [[0.04, 1.0], [0.06, 1.0]])
    np.testing.assert_allclose(holm(np.array([0.04, np.nan, 0.03])), [0.06, np.nan, 0.06])


def test_two_stores_are_paired_by_scene_seed_and_settings(tmp_path):
    choices = {"scenes": MANY, "metrics": ONE, "vary": {"num_particles": [25, 75]}}
    first = write_study(tmp_path / "a.sqlite", scores=[level], **choices)
    second = write_study(
        tmp_path / "b.sqlite", trackers=["loud", "soft"], **choices, runs=3, first_seed=102,
        scores=[lambda settings, scene, run: level(settings, scene, run + 2)],
    )  # fmt: skip
    found = compared(first, second)
    np.testing.assert_allclose(found.difference, 0, atol=1e-12)
    np.testing.assert_allclose(found.p_value, 1)
    assert (found.pairs.item(), found.alone) == (2 * 2 * 7 * 2, (2 * 2 * 7 * 2, 2 * 2 * 7))


def test_runs_that_one_side_cannot_judge_do_not_count(tmp_path):
    scores = [lambda settings, _, run: (1.0 * run, float(settings["tracker"] == "loud" or run != 2))]
    found = parts(write_study(tmp_path / "s.sqlite", metrics=ONE, scores=scores))
    assert found.pairs.tolist() == [[9]]
    np.testing.assert_allclose(found.second, (0 + 1 + 3) / 3)


def test_unfinished_cells_have_no_partner(tmp_path):
    path = write_study(tmp_path / "s.sqlite", scenes=MANY, metrics=ONE, scores=[level], finished=9)
    found = parts(path)
    assert (found.scenes.item(), found.alone) == (4, (4, 0))


def test_share_is_in_percent_and_metrics_of_one_side_are_left_out(tmp_path):
    both = write_study(tmp_path / "a.sqlite")
    one = write_study(tmp_path / "b.sqlite", metrics=[("track_loss", "%")], scores=[lambda *_: (1.0, 1.0)])
    found = compared(both, one, a=["tracker=soft"], b=["tracker=soft"])
    assert found.metrics == {"track_loss": "%"}
    np.testing.assert_allclose([found.first, found.second, found.difference], [[[25]], [[100]], [[-75]]])


def test_selected_factor_may_be_a_condition_of_the_scene(study):
    found = compared(study, a=["tracker=soft", "snr_db=5.0"], b=["tracker=loud", "snr_db=5"])
    assert (found.scenes.item(), found.alone) == (3, (0, 0))


@pytest.mark.parametrize(
    ("first", "second", "a", "b", "words"),
    [
        ({}, {}, ["tracker=soft"], ["tracker=laud"], ["--b: no cell has tracker=laud: tracker is soft, loud"]),
        ({}, {}, ["tracker"], [], ["--a must be NAME=VALUE", "'tracker'"]),
        ({}, {}, ["model=x"], [], ["--a: the study has no factor 'model'", "tracker, snr_db"]),
        ({}, {"metrics": [("rmse", "cm"), ("track_loss", "%")]}, [], [], ["rmse is defined in another way", "cm"]),
        ({}, {"metrics": ONE, "scores": [level], "scenes": MANY}, [], [], ["scene is a, b, c in one and s0, s1, s2"]),
        ({}, {"first_seed": 900}, [], [], ["no seed in common"]),
        ({}, {"fingerprint": "g"}, [], [], ["scene a is another recording in"]),
        ({}, {"trackers": ["new"]}, [], [], ["tracker is soft, loud in one and new in the other", "--a tracker=..."]),
        ({}, {"vary": {"hop": [1, 2]}}, [], [], ["--b leaves several values of hop (1, 2): say one as hop=VALUE"]),
        ({}, {}, ["tracker=soft"], [], ["--b leaves several values of tracker (soft, loud)"]),
        ({"finished": 0}, {}, [], [], ["nothing to compare yet: no cell is finished"]),
        ({"finished": 2}, {"scenes": dict(reversed(SCENES.items())), "finished": 2}, [], [], ["is a in one and c in"]),
        ({"config": {"metrics": ["rmse", "x"]}}, {"config": {"metrics": [{"class_path": "rmse"}, "x"]}}, [], [],
         ["metric rmse is defined in another way", "class_path"]),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_said(tmp_path, first, second, a, b, words):
    paths = [write_study(tmp_path / f"{i}.sqlite", **choices) for i, choices in enumerate((first, second))]
    with pytest.raises(InputError) as error:
        compared(*paths, a=a, b=b)
    assert [word for word in words if word not in str(error.value)] == []


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"metrics": ["rms"]}, "both studies need metric 'rms': they have rmse"),
        ({"by": ["model"]}, "by: the study has no factor 'model'"),
        ({"by": ["t60", "t60"]}, "by must differ, got t60 twice"),
        ({"metrics": ["rmse", "rmse"]}, "metrics must differ, got rmse twice"),
        ({"level": 0}, "level must lie between 0 and 1, got 0"),
    ],
)
def test_wrong_choice_is_said(study, choices, words):
    with pytest.raises(InputError, match=re.escape(words)):
        parts(study, **choices)


def said(capsys, *arguments):
    assert main(["study", "compare", *map(str, arguments)]) == 0
    return capsys.readouterr().out


SOFT_LOUD = ("--a", "tracker=soft", "--b", "tracker=loud")


def test_markdown(study, capsys):
    lines = said(capsys, study, *SOFT_LOUD, "--by", "snr_db", "--markdown").splitlines()
    assert lines[0] == "| SNR [dB] | metric | A | B | A - B | p | p Holm | pairs | scenes |"
    assert re.fullmatch(
        r"\| 0 \| rmse \[m\] \| \S+ \| \S+ \| \+0\.13\d \[\+0\.\d+, \+0\.\d+\] \| 0\.12 \| 0\.25 \| 16 \| 4 \|",
        lines[2],
    )
    assert lines[-7:] == [
        f"- A is {study} tracker=soft",
        f"- B is {study} tracker=loud",
        "- [low, high]: 95 % bootstrap interval, scenes drawn anew, and runs within them",
        "- p: of a difference as large if the signs of scenes were chance (permutation test)",
        "- p Holm: adjusted for the 2 tests of this table",
        "- 3 scenes: p cannot be below 0.25; over runs it says nothing of other scenes",
        "- 4 scenes: p Holm of 2 tests cannot be below 0.25",
    ]


def test_changes_of_sign_are_many_enough_for_all_tests_together(tmp_path, monkeypatch):
    many = {f"s{i}": {} for i in range(24)}
    metrics = [(f"m{i}", "m") for i in range(3)]
    path = write_study(tmp_path / "s.sqlite", scenes=many, runs=1, metrics=metrics, scores=[level] * 3)
    found = parts(path)
    # of 2^24 changes of sign two are as large: of 10 000 random ones none, but for a chance of 0.1 %
    np.testing.assert_allclose(found.p_value, 1 / 10_001)
    assert not any("cannot be below" in note for note in comparison_notes(found, "A", "B"))
    monkeypatch.setattr(comparison, "_FLIPS", 1)
    np.testing.assert_allclose(parts(path).adjusted, 3 / 121)


@pytest.mark.parametrize(("tests", "said"), [(3, []), (5, ["7 scenes: p Holm of 5 tests cannot be below 0.078"])])
def test_too_few_scenes_for_so_many_tests_is_said(tmp_path, tests, said):
    metrics = [(f"m{i}", "m") for i in range(tests)]
    path = write_study(tmp_path / "s.sqlite", scenes=MANY, metrics=metrics, scores=[level] * tests)
    found = parts(path)
    assert [note for note in comparison_notes(found, "A", "B") if "cannot be below" in note] == said
    np.testing.assert_allclose(found.adjusted, tests / 64)
    assert not any("cannot be below" in note for note in comparison_notes(parts(path, over="runs"), "A", "B"))


def test_table_of_one_test_is_not_adjusted(study, capsys):
    out = said(capsys, study, *SOFT_LOUD)
    assert "Holm" not in out
    assert "p cannot be below" not in out
    assert " 0.016 " in out


def test_json_has_the_figures(study, capsys):
    content = json.loads(said(capsys, study, *SOFT_LOUD, "--json", "--over", "runs"))
    (row,) = content["rows"]
    assert (row["metric"], row["unit"], row["pairs"], row["scenes"]) == ("rmse", "m", 28, 7)
    np.testing.assert_allclose(row["difference"], 0.1315)
    assert (content["alone"], content["over"]) == ([0, 0], "runs")


def test_partners_that_are_missing_are_counted(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", scenes=MANY, metrics=ONE, scores=[level], finished=9)
    assert "4 runs of A have no partner and do not count" in said(capsys, path, *SOFT_LOUD)


def test_one_form_is_printed(study, capsys):
    assert main(["study", "compare", str(study), *SOFT_LOUD, "--json", "--markdown"]) == 2
    assert "--json or --markdown can be printed, not both" in capsys.readouterr().err


def test_one_store_needs_two_parts(study, capsys):
    assert main(["study", "compare", str(study), "--a", "tracker=soft"]) == 2
    assert "give a second store, or choose two parts of one" in capsys.readouterr().err
