"""The training step: seeds, the validation loss, what is not finite, and the parameters of a model in files."""

import re
import warnings
from types import SimpleNamespace

import fit_walks
import lightning
import pytest
import torch
import yaml
from lightning.fabric.utilities.distributed import DistributedSamplerWrapper

from probtrack.errors import InputError, NotFiniteError
from probtrack.switching import MarkovChain
from probtrack.training import SceneSampler, physical_summary, physical_values, read_parameters, write_parameters
from probtrack.training.checkpoints import Checkpoints
from probtrack.training.reporting import short_names


def trainer(tmp_path, **settings):
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    return lightning.Trainer(
        accelerator="cpu", max_epochs=1, enable_model_summary=False, default_root_dir=tmp_path, **quiet, **settings
    )


@pytest.fixture(autouse=True)
def quiet():
    """Lightning's own warnings: of what torch deprecates, and of loaders without workers."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        warnings.filterwarnings("ignore", message=".*LeafSpec.*is deprecated")
        yield


def test_seeds_are_those_of_sequence_epoch_and_fit():
    fit, other = fit_walks.WalkFit(seed=1), fit_walks.WalkFit(seed=2)
    many = fit.seeds([torch.arange(7)], 3)
    assert len(set(many.tolist())) == 7
    assert torch.equal(fit.seeds([torch.tensor([5, 2])], 3), many[[5, 2]])
    assert not set(fit.seeds([torch.arange(7)], 4).tolist()) & set(many.tolist())
    assert not set(other.seeds([torch.arange(7)], 3).tolist()) & set(many.tolist())


def test_validation_loss_is_the_mean_of_all_sequences_whatever_the_batches(tmp_path):
    fit, data = fit_walks.WalkFit(scale=1.5), fit_walks.WalkData()
    (said,) = trainer(tmp_path).validate(fit, datamodule=data, verbose=False)
    with torch.no_grad():
        one_by_one = [fit.run_loss([torch.tensor([n]), data.val.steps[n : n + 1]], 2**31) for n in range(5)]
    assert said["val/loss"] == pytest.approx(float(torch.cat(one_by_one).mean()), rel=1e-6)  # it is told in float32


def test_each_process_gets_its_own_recordings_of_one_draw():
    samplers = [SceneSampler(12, 3) for _ in range(2)]
    for sampler in samplers:
        sampler.set_epoch(4)
    parts = [list(DistributedSamplerWrapper(s, num_replicas=2, rank=r)) for r, s in enumerate(samplers)]
    assert sorted(parts[0] + parts[1]) == [(number, 4) for number in range(12)]


def test_gradient_that_is_not_finite_names_its_parameter_and_reaches_none(tmp_path):
    fit = fit_walks.WalkFit(steep=True)
    with pytest.raises(NotFiniteError, match=r"the gradient of drift is not finite in epoch 1, batch 1 \(sequences \d"):
        trainer(tmp_path).fit(fit, datamodule=fit_walks.WalkData())
    assert fit.model.drift.tolist() == [0.0, 0.0]
    assert fit.model.log_scale.tolist() == 0.0


def test_parameter_that_is_not_a_number_is_named_and_a_probability_of_0_is_not(tmp_path):
    fit = fit_walks.WalkFit(scale=float("nan"))
    fit.model.logit_initial.data[1] = -torch.inf
    with pytest.raises(NotFiniteError, match=r"\); parameters that are not finite: log_scale\. Try"):
        trainer(tmp_path).fit(fit, datamodule=fit_walks.WalkData())


def test_validation_loss_that_is_not_finite_names_its_batch(tmp_path):
    data = fit_walks.WalkData()
    data.val.steps = data.val.steps.index_fill(0, torch.tensor([4]), torch.nan)
    with pytest.raises(NotFiniteError, match=r"the validation loss is nan in epoch 1, batch 2 \(sequences 3, 4\)"):
        trainer(tmp_path).validate(fit_walks.WalkFit(), datamodule=data, verbose=False)


def test_checkpoint_that_is_cut_short_leaves_the_one_before(tmp_path):
    class Cut(Exception):
        pass

    def save(path, *, weights_only):
        path.write_text("new" if whole else "ne")
        if weights_only or not whole:
            raise Cut

    told = SimpleNamespace(save_checkpoint=save, is_global_zero=True, sanity_checking=False, callback_metrics={})
    checkpoints, whole = Checkpoints(tmp_path), True
    checkpoints.on_train_epoch_end(told, None)
    whole = False
    with pytest.raises(Cut):
        checkpoints.on_train_epoch_end(told, None)
    assert (tmp_path / "last.ckpt").read_text() == "new"


def test_best_is_the_lowest_validation_loss_and_no_epoch_counts_twice(tmp_path):
    saved = []
    metrics = {}
    told = SimpleNamespace(
        save_checkpoint=lambda path, **_: (saved.append(path.name), path.touch()),
        is_global_zero=True,
        sanity_checking=False,
        callback_metrics=metrics,
    )
    checkpoints = Checkpoints(tmp_path)
    for loss in (3.0, 2.0, None, 2.5, 1.0):
        saved.clear()
        if loss is not None:
            metrics["val/loss"] = torch.tensor(loss)
            checkpoints.on_validation_end(told, None)
        checkpoints.on_train_epoch_end(told, None)
        assert ("best.ckpt.tmp" in saved) == (loss in (3.0, 2.0, 1.0))
        assert saved[-1] == "last.ckpt.tmp"
    told.sanity_checking = True
    metrics["val/loss"] = torch.tensor(0.5)
    checkpoints.on_validation_end(told, None)
    checkpoints.on_train_epoch_end(told, None)
    assert checkpoints.best == 1.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_parameters_come_back_from_their_file(tmp_path, dtype):
    chain = MarkovChain([0.3, 0.7, 0.0], [[0.9, 0.1, 0.0], [0.2, 0.5, 0.3], [1 / 3, 1 / 3, 1 / 3]]).to(dtype)
    walk = torch.nn.ModuleDict({"walk": fit_walks.Walk(0.1), "chain": chain}).to(dtype)
    write_parameters(tmp_path / "p.yaml", walk, {"seed": 3})
    text = (tmp_path / "p.yaml").read_text()
    longest = 11 if dtype == torch.float32 else 20  # no more digits than the number has
    assert re.search(rf"walk\.scale: [\d.]{{3,{longest}}}\n", text)
    assert yaml.safe_load(text)["made_by"] == {"seed": 3}
    other = torch.nn.ModuleDict({"walk": fit_walks.Walk(7.0), "chain": MarkovChain([1, 0, 0], torch.eye(3))}).to(dtype)
    read_parameters(tmp_path / "p.yaml", other)
    for name, value in physical_values(walk).items():
        torch.testing.assert_close(physical_values(other)[name], value)
    assert chain.logit_initial.isneginf().tolist() == other["chain"].logit_initial.isneginf().tolist()


def test_frozen_parameters_are_not_written_and_may_be_set(tmp_path):
    walk = fit_walks.Walk(2.0)
    walk.drift.requires_grad_(False)
    write_parameters(tmp_path / "p.yaml", walk, {})
    assert yaml.safe_load((tmp_path / "p.yaml").read_text())["parameters"].keys() == {"scale", "initial"}
    read_parameters(tmp_path / "p.yaml", walk)
    (tmp_path / "p.yaml").write_text("parameters: {scale: 1.0, drift: [4.0, 5.0], initial: [0.5, 0.5]}")
    read_parameters(tmp_path / "p.yaml", walk)
    assert walk.drift.tolist() == [4.0, 5.0]


GOOD = {"scale": 1.0, "drift": [0.0, 0.0], "initial": [0.5, 0.5]}


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (GOOD | {"size": 1.0}, "p.yaml: parameters of another model: unknown size$"),
        ({"drift": [0.0, 0.0], "size": 2.0}, "another model: missing initial, scale; unknown size$"),
        (GOOD | {"drift": [0.0, 0.0, 0.0]}, r"p.yaml: drift must have shape \(2,\), got \(3,\)"),
        (GOOD | {"drift": [[0.0], [0.0, 1.0]]}, "drift must be a number, or rows of as many numbers each"),
        (GOOD | {"scale": "wide"}, "scale must be a number, or rows of as many numbers each, got 'wide'"),
        (GOOD | {"scale": -1.0}, "scale must be finite and positive, got -1.0"),
        (GOOD | {"scale": 0.0}, "scale must be finite and positive, got 0.0"),
        (GOOD | {"drift": [0.0, float("inf")]}, r"drift must be finite, got \[0.0, inf\]"),
        (GOOD | {"initial": [0.5, 0.6]}, r"initial must be probabilities with sum 1 in each row, got \[0.5, 0.6\]"),
        (GOOD | {"initial": [1.5, -0.5]}, "initial must be probabilities"),
        ([1.0], "p.yaml: a parameter file must have 'parameters'"),
    ],
)
def test_refuses_parameters_and_leaves_the_module_as_it_was(tmp_path, parameters, said):
    (tmp_path / "p.yaml").write_text(yaml.safe_dump({"parameters": parameters}))
    walk = fit_walks.Walk(3.0)
    before = physical_values(walk)
    with pytest.raises(InputError, match=said):
        read_parameters(tmp_path / "p.yaml", walk)
    for name, value in physical_values(walk).items():
        assert torch.equal(value, before[name])


def test_tables_are_summarised_by_their_range():
    walk = fit_walks.Walk(2.0)
    walk.drift.data = torch.tensor([-1.0, 0.5])
    assert physical_summary(walk) == pytest.approx({"scale": 2.0, "drift_range": 1.5, "initial_range": 0.0})


def test_short_names_are_the_shortest_that_differ():
    assert short_names(["a.x.rate", "b.x.rate", "b.y.speed"]) == {
        "a.x.rate": "a.x.rate",
        "b.x.rate": "b.x.rate",
        "b.y.speed": "speed",
    }
    assert short_names(["a.x.rate", "a.y.rate"]) == {"a.x.rate": "x.rate", "a.y.rate": "y.rate"}
    assert short_names(["rate", "x.rate"]) == {"rate": "rate", "x.rate": "x.rate"}
