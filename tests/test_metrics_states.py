"""What all metrics have in common: sums that add up over updates and processes, names, units."""

import copy
import pickle
import subprocess
import sys

import pytest
import torch
from talkers import at
from torchmetrics import MetricCollection

import probtrack.metrics
from probtrack.metrics import Talkers, known

NAMES = tuple(known())


def recording(seed, *, dtype=torch.float64, runs=3, frames=12):
    """A talker who walks, and runs that follow with an error; all columns that a metric may look at."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    path = draw(frames, 1, 1, 2).cumsum(0) * 0.1 + 2
    azimuth, heading = draw(frames, 1, 1), draw(frames, 1, 1)
    truth = at(path, azimuth=azimuth, heading=heading, speech=(draw(frames, 1, 1) > -0.5).double())
    root = 0.2 * draw(frames, runs, 1, 2, 2)
    estimate = at(
        path + 0.3 * draw(frames, runs, 1, 2),
        azimuth=azimuth + 0.2 * draw(frames, runs, 1),
        heading=heading + 0.2 * draw(frames, runs, 1),
        covariance=root @ root.mT + 0.01 * torch.eye(2),
        std_azimuth=0.3 * draw(frames, runs, 1).abs(),
        std_heading=0.2 * draw(frames, runs, 1).abs(),
    )
    return tuple(Talkers._make(None if x is None else x.to(dtype) for x in one) for one in (estimate, truth))


@pytest.mark.parametrize("name", NAMES)
def test_two_updates_are_the_ratio_of_the_sums_of_both(name):
    metric, parts = known()[name](), []
    for seed, runs in ((1, 3), (2, 5)):
        metric.update(*recording(seed, runs=runs))
        parts.append(metric.parts(*recording(seed, runs=runs)))
    assert [len(part.total) for part in parts] == [3, 5]
    expected = sum(part.total.sum() for part in parts) / sum(part.count.sum() for part in parts)
    assert expected.isfinite()
    torch.testing.assert_close(metric.compute(), expected)


@pytest.mark.parametrize("name", NAMES)
def test_states_of_two_processes_add_up(name):
    # as torchmetrics' sync does with states that are declared sums
    whole, one, other = (known()[name]() for _ in range(3))
    one.update(*recording(1))
    other.update(*recording(2, runs=5))
    whole.update(*recording(1))
    whole.update(*recording(2, runs=5))
    one.merge_state(other)
    torch.testing.assert_close(one.compute(), whole.compute())


@pytest.mark.parametrize("name", NAMES)
def test_a_pickled_metric_goes_on(name):
    metric = known()[name]()
    metric.update(*recording(1))
    other = pickle.loads(pickle.dumps(metric))
    torch.testing.assert_close(other.compute(), metric.compute())
    other.update(*recording(2))
    assert other.count > metric.count


@pytest.mark.parametrize("name", NAMES)
def test_float32_gives_the_same_figure(name):
    metric, single = known()[name](), known()[name]()
    metric.update(*recording(1))
    single.update(*recording(1, dtype=torch.float32))
    assert single.compute().dtype == torch.float64
    torch.testing.assert_close(single.compute(), metric.compute(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_judging_changes_neither_estimate_nor_truth(name):
    estimate, truth = recording(1)
    before = copy.deepcopy((estimate, truth))
    known()[name]().parts(estimate, truth)
    for now, then in zip((*estimate, *truth), (*before[0], *before[1]), strict=True):
        assert now is then or torch.equal(now, then)


def test_reset_forgets():
    metric = known()["rmse"]()
    metric.update(*recording(1))
    metric.reset()
    assert (metric.total, metric.count) == (0, 0)
    metric.update(*recording(2))
    fresh = known()["rmse"]()
    fresh.update(*recording(2))
    assert metric.compute() == fresh.compute()


def test_a_call_gives_the_figure_of_its_batch_and_keeps_the_sums():
    metric, other = known()["rmse"](), known()["rmse"]()
    metric(*recording(1))
    alone = metric(*recording(2))
    other.update(*recording(2))
    assert alone == other.compute()
    assert metric.compute() != alone


def test_a_collection_keeps_each_metric_its_own():
    collection = MetricCollection({name: known()[name]() for name in NAMES})
    collection.update(*recording(1))
    collection.update(*recording(2))
    for name, figure in collection.compute().items():
        alone = known()[name]()
        alone.update(*recording(1))
        alone.update(*recording(2))
        torch.testing.assert_close(figure, alone.compute())


def test_known_metrics_go_by_their_names_and_say_their_units():
    units = {"m", "m^2", "rad", "rad^2", "s", "1/s", "%", ""}
    for name, metric in known().items():
        assert (metric().name, metric.unit in units) == (name, True)
        assert set(metric.needs) | set(metric.wants) <= set(Talkers._fields)


def test_names_of_the_room_are_there():
    for name in dir(probtrack.metrics):
        assert getattr(probtrack.metrics, name).__module__.startswith("probtrack.metrics")
    with pytest.raises(AttributeError, match="no attribute 'accuracy'"):
        probtrack.metrics.accuracy  # noqa: B018


def test_scoring_a_file_does_without_torchmetrics():
    code = "import sys; from probtrack.metrics import score; "
    code += "assert callable(score) and 'torchmetrics' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
