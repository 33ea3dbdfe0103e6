"""Random numbers of a filter: a run's own, whatever happens around it."""

import pytest
import torch

from probtrack.errors import InputError
from probtrack.filters import NoiseStream, noise
from probtrack.filters.noise import FrameNoise


def frames(stream, count):
    drawn = [stream.frame() for _ in range(count)]
    return FrameNoise(torch.stack([f.normal for f in drawn]), torch.stack([f.uniform for f in drawn]))


def test_a_run_draws_the_same_numbers_in_any_batch():
    seeds = torch.tensor([[3, 8, 11], [900, 5, 2**40]])
    together, start = NoiseStream(seeds, 7, 2, 5), NoiseStream(seeds, 7, 2, 5).uniform(7, 2)
    together.uniform(7, 2)
    batch = frames(together, 150)
    for index in [(0, 0), (0, 2), (1, 1), (1, 2)]:
        alone = NoiseStream(int(seeds[index]), 7, 2, 5)
        assert torch.equal(alone.uniform(7, 2), start[index])
        own = frames(alone, 150)
        assert torch.equal(own.normal, batch.normal[:, *index])
        assert torch.equal(own.uniform, batch.uniform[:, *index])


def test_the_global_generator_is_neither_read_nor_moved():
    torch.manual_seed(1)
    first = frames(NoiseStream(4, 7, 2, 1), 3)
    after = torch.rand(3)
    torch.manual_seed(1)
    assert torch.equal(torch.rand(3), after)
    again = frames(NoiseStream(4, 7, 2, 1), 3)
    assert torch.equal(first.normal, again.normal)
    assert torch.equal(first.uniform, again.uniform)


def test_other_seeds_give_other_numbers():
    drawn = frames(NoiseStream(torch.tensor([1, 2, 3]), 7, 2, 1), 2).normal
    assert not torch.equal(drawn[:, 0], drawn[:, 1])
    assert not torch.equal(drawn[:, 1], drawn[:, 2])


@pytest.mark.parametrize("sizes", [(75, 2, 1), (5, 3, 5), (4000, 2, 4000), (2**17, 1, 1)])
def test_shapes(sizes):
    num_particles, num_normals, num_uniforms = sizes
    stream = NoiseStream(torch.tensor([[3], [4]]), *sizes)
    frame = stream.frame()
    assert frame.normal.shape == (2, 1, num_particles, num_normals)
    assert frame.uniform.shape == (2, 1, num_uniforms)
    assert stream.normal(5, 3).shape == stream.uniform(5, 3).shape == (2, 1, 5, 3)


def test_frames_are_standard_normal_and_uniform_and_never_repeat(monkeypatch):
    monkeypatch.setattr(noise, "_BLOCK", 600)  # six frames a block, ten blocks
    drawn = frames(NoiseStream(5, 50, 2, 50), 60)
    normal, uniform = drawn.normal.flatten(), drawn.uniform.flatten()
    size = len(normal)
    assert normal.mean().abs() < 5 / size**0.5
    assert (normal.var() - 1).abs() < 5 * (2 / size) ** 0.5
    assert (normal.pow(4).mean() - 3).abs() < 5 * (96 / size) ** 0.5
    assert (uniform.mean() - 0.5).abs() < 5 * (12 * len(uniform)) ** -0.5
    assert (uniform.var() - 1 / 12).abs() < 5 * (180 * len(uniform)) ** -0.5
    assert ((uniform >= 0) & (uniform < 1)).all()
    assert len(normal.unique()) == size
    assert len(uniform.unique()) == len(uniform)


def test_frames_are_independent_across_the_end_of_a_block(monkeypatch):
    monkeypatch.setattr(noise, "_BLOCK", 2 * 400 * 2)  # two frames a block
    normal = frames(NoiseStream(6, 400, 2, 1), 40).normal.flatten(1)
    correlation = (normal[1:] * normal[:-1]).mean(1)
    assert (correlation.abs() < 5 / 800**0.5).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, None])
def test_numbers_have_the_dtype_asked_for(dtype):
    stream = NoiseStream(0, 7, 2, 1, dtype=dtype)
    wanted = dtype or torch.float64  # the tests' default
    frame = stream.frame()
    assert frame.normal.dtype == frame.uniform.dtype == stream.normal(2).dtype == stream.uniform(2).dtype == wanted


def test_a_model_without_noise_needs_none():
    assert NoiseStream(0, 7, 0, 1).frame().normal.shape == (7, 0)


def test_seeds_are_integers():
    with pytest.raises(InputError, match=r"seeds must be integers, got torch\.float64"):
        NoiseStream(torch.tensor([0.5, 0.7]), 7, 2, 1)


def test_needs_a_particle():
    with pytest.raises(InputError, match="num_particles must be an integer of at least 1, got 0"):
        NoiseStream(0, 0, 2, 1)
