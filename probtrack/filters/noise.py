"""The random numbers of a particle filter: every run has its own stream, whatever batch it sits in."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack.errors import InputError

_BLOCK = 2**17  # normal numbers a run draws at once: enough to hide the call, small enough for a cache
_FRAMES = 64


class FrameNoise(NamedTuple):
    """Random numbers of one frame.

    Attributes:
        normal: Standard normal numbers (*batch, N, K) that drive the motion.
        uniform: Numbers uniform in [0, 1) (*batch, U) that drive the resampling.
    """

    normal: Tensor
    uniform: Tensor


class NoiseStream:
    """Endless random numbers for runs that are told apart by their seeds.

    A run's numbers depend on its seed and its own sizes, not on the other runs of the batch, on how a
    sequence is cut into calls, or on torch's global generator.

    Args:
        seeds: One seed a run, (*batch) integers; a single number for a filter without batch.
        num_particles: N.
        num_normals: K, normal numbers per particle and frame.
        num_uniforms: U, uniform numbers per run and frame.
        dtype: Of the numbers; torch's default if None.
    """

    def __init__(
        self,
        seeds: Tensor | int,
        num_particles: int,
        num_normals: int,
        num_uniforms: int,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | None = None,
    ) -> None:
        try:
            seeds = torch.as_tensor(seeds)
        except (ValueError, OverflowError, RuntimeError):
            raise InputError(f"seeds must be integers of at most 64 bits, got {seeds}") from None
        if seeds.is_floating_point() or seeds.is_complex():
            raise InputError(f"seeds must be integers, got {seeds.dtype}")
        check_int(num_particles, "num_particles", low=1)
        self.batch = tuple(seeds.shape)
        self._generators = [
            torch.Generator(device or "cpu").manual_seed(int(seed)) for seed in seeds.flatten().tolist()
        ]
        frames = max(1, min(_FRAMES, _BLOCK // max(1, num_particles * num_normals)))
        self._normal_shape = (frames, num_normals, num_particles)
        self._uniform_shape = (frames, num_uniforms)
        self._like = torch.empty((), dtype=dtype or torch.get_default_dtype(), device=device)
        self._frames = self._draw_frames()

    def frame(self) -> FrameNoise:
        """Return the numbers of the next frame."""
        return next(self._frames)

    def uniform(self, *shape: int) -> Tensor:
        """Return (*batch, *shape) numbers uniform in [0, 1), drawn now."""
        return self._drawn(shape, Tensor.uniform_)

    def normal(self, *shape: int) -> Tensor:
        """Return (*batch, *shape) standard normal numbers, drawn now."""
        return self._drawn(shape, Tensor.normal_)

    def _drawn(self, shape: tuple[int, ...], fill: Callable[..., Tensor]) -> Tensor:
        numbers = self._like.new_empty((len(self._generators), *shape))
        for row, generator in zip(numbers, self._generators, strict=True):
            fill(row, generator=generator)
        return numbers.view(*self.batch, *shape)

    def _draw_frames(self) -> Iterator[FrameNoise]:
        axis = len(self.batch)
        while True:
            normal, uniform = self.normal(*self._normal_shape), self.uniform(*self._uniform_shape)
            # drawn variables first, which is how clouds lie in memory
            for pair in zip(normal.mT.unbind(axis), uniform.unbind(axis), strict=True):
                yield FrameNoise(*pair)
