import dataclasses
import warnings

import pytest
import torch
import training_scenes
from training_scenes import array, front_end

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation import read_manifest
from probtrack.training import Lehmann2007FrontEnd, SceneDataset, SceneSampler, front_end_key
from probtrack.training.batches import BatchesOfOneLength
from probtrack.training.splitting import split_by_scene

lightning = pytest.importorskip("lightning")
from probtrack.training import SceneDataModule  # noqa: E402

small_data_set, data_set = training_scenes.small_data_set, training_scenes.data_set
THIRDS = (0.34, 0.33, 0.33)


def epoch(loader):
    return [(batch.names, batch.start.tolist()) for batch in loader]


def manifest(folder, scenes, snrs=2):
    folder.mkdir()
    lines = [f"{i}_{s},{i},0,1,{s},1,8.0" for i in range(scenes) for s in range(snrs)]
    (folder / "manifest.csv").write_text("\n".join(["folder,scene,template,seed,snr_db,num_talkers,duration", *lines]))
    return folder


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("shares", "counts"), [((0.8, 0.1, 0.1), (8, 1, 1)), ((0.5, 0.5, 0.0), (5, 5, 0))])
def test_no_scene_is_on_both_sides_of_a_split(tmp_path, seed, shares, counts):
    folder = manifest(tmp_path / "set", 10, 3)
    parts = split_by_scene(folder, shares, seed)
    scenes = [{path.name.split("_")[0] for path in part} for part in parts]
    assert tuple(map(len, scenes)) == counts
    assert [len(part) for part in parts] == [3 * count for count in counts]
    assert set.union(*scenes) == set(map(str, range(10)))
    assert parts == split_by_scene(folder, shares, seed)


def test_split_depends_on_the_seed_and_leaves_no_part_empty(tmp_path):
    folder = manifest(tmp_path / "set", 10)
    assert split_by_scene(folder, THIRDS, 0) != split_by_scene(folder, THIRDS, 1)
    for scenes in range(3, 12):
        sizes = [len(p) for p in split_by_scene(manifest(tmp_path / f"{scenes}", scenes, 1), (0.96, 0.02, 0.02))]
        assert sizes == [scenes - 2, 1, 1]
    thirds = [len(p) for p in split_by_scene(manifest(tmp_path / "many", 101, 1), (1 / 3, 1 / 3, 1 / 3))]
    assert sorted(thirds) == [33, 34, 34]


def test_parts_of_a_module_share_no_scene_and_hold_all(data_set):
    data = SceneDataModule(str(data_set), split=THIRDS)
    data.setup()
    scenes = {name: {f.path.name.split("_")[0] for f in one.folders} for name, one in data.datasets.items()}
    assert sorted(scene for part in scenes.values() for scene in part) == ["0", "1", "2"]
    assert sum(len(one) for one in data.datasets.values()) == len(read_manifest(data_set))


def test_training_order_is_that_of_seed_and_epoch(data_set):
    def module(seed):
        return SceneDataModule(str(data_set), batch_size=2, crop=20, seed=seed).train_dataloader()

    loader, again = module(3), module(3)
    epochs = [epoch(loader) for _ in range(3)]
    assert epochs == [epoch(again) for _ in range(3)]
    assert epochs[0] != epochs[1] != epochs[2]
    assert epoch(module(4)) != epochs[0]
    again.sampler.set_epoch(1)  # as when training is gone on with
    assert epoch(again) == epochs[1]
    for one in epochs:
        assert sorted(name for names, _ in one for name in names) == sorted(
            r["folder"] for r in read_manifest(data_set)
        )


def test_sampler_leaves_the_global_generator_alone(data_set):
    loader = SceneDataModule(str(data_set), crop=20).train_dataloader()
    before = torch.get_rng_state()
    epoch(loader)
    assert torch.equal(torch.get_rng_state(), before)
    assert len(loader.sampler) == 6


@pytest.mark.slow
def test_workers_do_not_change_the_numbers(data_set, tmp_path):
    def batches(workers):
        data = SceneDataModule(
            str(data_set),
            front_end=Lehmann2007FrontEnd(),
            batch_size=3,
            crop=25,
            workers=workers,
            cache=str(tmp_path / f"{workers}"),
        )
        loader = data.train_dataloader()
        return [batch for _ in range(2) for batch in loader]

    for one, other in zip(batches(0), batches(2), strict=True):
        assert one.names == other.names
        assert torch.equal(one.start, other.start)
        assert torch.equal(one.observations.gcc, other.observations.gcc)
        assert torch.equal(one.observations.speech, other.observations.speech)
        assert torch.equal(one.truth.position, other.truth.position)
    assert one.observations.gcc.dtype == torch.float64


def test_tests_are_whole_and_in_batches_of_one_length(data_set):
    dataset = SceneDataset(data_set)
    dataset.num_frames = lambda number: [7, 9, 7, 7, 9, 7][number]
    lengths = [dataset.num_frames(number) for number in range(6)]
    batches = BatchesOfOneLength(range(6), 3, drop_last=False, lengths=lengths)
    assert list(batches) == [[0, 2, 3], [5], [1, 4]]
    assert len(batches) == 3
    assert list(BatchesOfOneLength([1, 2, 4, 5], 3, drop_last=False, lengths=lengths)) == [[1, 4], [2, 5]]
    data = SceneDataModule(str(data_set), test=[str(data_set / "0_+5dB")], crop=10)
    with pytest.raises(InputError, match="is both for train and for test"):
        data.setup()
    data = SceneDataModule(str(data_set), split=(0.5, 0.0, 0.5), crop=10, batch_size=8)
    (batch,) = data.test_dataloader()
    assert batch.num_frames == SceneDataset(data_set).num_frames(0)
    assert next(iter(data.train_dataloader())).num_frames == 10
    assert data.val_dataloader() == []


def test_front_end_is_given_or_made_for_the_array(data_set):
    made = SceneDataModule(str(data_set), front_end=Lehmann2007FrontEnd(hop=512))
    given = SceneDataModule(str(data_set), front_end=front_end(hop=512))
    for data in (made, given):
        data.setup()
        key = data.datasets["train"].files.key
        assert key == front_end_key(front_end(hop=512), 16_000)
    sound = SceneDataModule(str(data_set), front_end=front_end(hop=512), audio=True, batch_size=1, crop=5)
    batch = next(iter(sound.train_dataloader()))
    assert batch.observations is None
    assert batch.audio.shape == (1, 3, 5 * 512)
    assert batch.truth.known.shape == (5, 1, 2)


def test_arrays_that_differ_are_refused(data_set):
    moved = array().positions.clone()
    moved[1, 0] += 0.001
    MicrophoneArray(moved).to_yaml(data_set / "2_+5dB" / "array.yaml")
    SceneDataModule(str(data_set)).setup()
    with pytest.raises(InputError, match=r"2_.5dB: has another array than .*0_.5dB, and a front end is for one"):
        SceneDataModule(str(data_set), front_end=Lehmann2007FrontEnd()).setup()


def test_wrong_settings_are_said_in_one_line(data_set):
    few = str(data_set)
    wrong = [
        ("at least one of train, val and test", lambda: SceneDataModule()),
        ("split parts the scenes of train", lambda: SceneDataModule(few, few, split=THIRDS)),
        ("split needs train to be the folder", lambda: SceneDataModule([few], split=THIRDS).setup()),
        ("shares of at least 0 with sum 1", lambda: SceneDataModule(few, split=(0.8, 0.8, -0.6)).setup()),
        ("shares of at least 0 with sum 1", lambda: SceneDataModule(few, split=(0.8, 0.1, 0.0)).setup()),
        ("3 scenes are fewer", lambda: split_by_scene(few, (0.25, 0.25, 0.25, 0.25))),
        ("batch_size must be", lambda: SceneDataModule(few, batch_size=0)),
        ("workers must be", lambda: SceneDataModule(few, workers=-1)),
        ("there are no scenes for train", lambda: SceneDataModule(test=few).train_dataloader()),
        ("cannot read the manifest", lambda: SceneDataModule(few + "/0_+5dB").setup()),
    ]
    for message, make in wrong:
        with pytest.raises(InputError, match=message) as error:
            make()
        assert "\n" not in str(error.value)
    (data_set / "1_+5dB" / "truth.csv").unlink()
    with pytest.raises(InputError, match=r"1_.5dB: has no truth.csv, and truth is wanted here"):
        SceneDataModule(few).setup()
    SceneDataModule(few, require_truth=False).setup()


def test_configuration_file_fills_the_module(data_set):
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(SceneDataModule, "data")
    made = {"class_path": "probtrack.training.Lehmann2007FrontEnd", "init_args": {"hop": 512}}
    content = {"train": str(data_set), "split": list(THIRDS), "front_end": made, "crop": 9, "workers": 1}
    data = parser.instantiate(parser.parse_object({"data": content})).data
    assert data.front_end == Lehmann2007FrontEnd(hop=512)
    assert (data.crop, data.workers, tuple(data.split)) == (9, 1, THIRDS)
    assert dataclasses.is_dataclass(data.front_end)


class TinyModel(lightning.LightningModule):
    """Learns the mean position, and remembers what it was given."""

    def __init__(self):
        super().__init__()
        self.mean, self.seen = torch.nn.Parameter(torch.zeros(3)), []

    def training_step(self, batch, _):
        self.seen.append(("train", batch.observations.gcc.shape[:2], batch.truth.known.shape))
        return (batch.truth.position - self.mean).square()[batch.truth.known].mean()

    def validation_step(self, batch, _):
        self.seen.append(("val", batch.observations.gcc.shape[:2], batch.truth.known.shape))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_trainer_fits_a_model_to_batches(data_set, tmp_path, dtype):
    torch.set_default_dtype(dtype)
    data = SceneDataModule(str(data_set), split=(0.7, 0.3, 0.0), front_end=Lehmann2007FrontEnd(), batch_size=2, crop=30)
    model = TinyModel()
    with warnings.catch_warnings():
        # Lightning's own: of what torch deprecates, and of loaders without workers
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        warnings.filterwarnings("ignore", message=".*LeafSpec.*is deprecated")
        trainer = lightning.Trainer(
            accelerator="cpu",
            fast_dev_run=True,
            logger=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=tmp_path,
        )
        trainer.fit(model, datamodule=data)
    assert model.seen == [("train", (30, 2), (30, 2, 2)), ("val", (80, 2), (80, 2, 2))]
    assert model.mean.dtype == dtype
    assert model.mean.abs().min() > 0


def test_an_epoch_has_an_order_and_a_draw_of_its_own():
    sampler = SceneSampler(20, 3)
    first, second = (list(zip(*sampler, strict=True)) for _ in range(2))
    assert sorted(first[0]) == sorted(second[0]) == list(range(20))
    assert first[0] != second[0]
    assert (set(first[1]), set(second[1])) == ({0}, {1})


def test_sampler_rejects():
    with pytest.raises(InputError, match="count must be"):
        SceneSampler(0)
