"""The beamformer likelihood of S1, gated by voice activity."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive, check_int
from probtrack.dynamics import Kinematics
from probtrack.errors import InputError
from probtrack.geometry import Region
from probtrack.likelihoods.base import EvidenceMap, Likelihood

_SMALLEST_POWER = 1e-6  # of 1: interpolated power may fall below 0 by rounding; powers of it must not be NaN


class CorrelationsAndSpeech(Protocol):
    """What a front end observes: pair correlations `gcc` (T, *batch, P, K), `speech` (T, *batch)."""

    @property
    def gcc(self) -> Tensor: ...

    @property
    def speech(self) -> Tensor: ...


class TabulatedPower(Protocol):
    """A module that knows the steered power, such as `probtrack.audio.SteeredResponsePower`."""

    def distances(self, points: Tensor) -> Tensor:
        """Return the way from `points` (*batch, N, A) to each microphone, (*batch, N, M) [m]."""

    def steered(self, gcc: Tensor, distances: Tensor) -> Tensor:
        """Return the power (*batch, N) at points with these `distances` to the microphones."""

    def at(self, points: Tensor) -> Callable[[Tensor], Tensor]:
        """Return what maps gcc (..., P, K) to the power (..., G) at `points` (G, A) that stay the same."""


class PreparedPower(NamedTuple):
    """A block of observations with the weights of both mixture terms.

    Attributes:
        gcc: Pair correlations (T, *batch, P, K).
        clutter: Density of a clutter measurement, q_0 / |D|, (T, *batch, 1).
        scale: One over the largest power on the grid (T, *batch, 1), which keeps large powers of it in range.
        target: What multiplies (scale P)^r, (T, *batch, 1).
    """

    gcc: Tensor
    clutter: Tensor
    scale: Tensor
    target: Tensor


class SteeredPowerLikelihood(Likelihood):
    r"""A peak of the steered power is the talker with the probability of speech, or else clutter anywhere.

    .. math::
        p(y \mid \ell) = q_0\, \mathcal U_D(\ell) + \gamma (1 - q_0)\, P(\ell)^r, \qquad q_0 = 1 - \alpha,
        \qquad \gamma^{-1} = \int_D P(\ell)^r d\ell

    and 0 outside D, the region without what is nearer than `keep_out` to a microphone. P is the output power of
    a beamformer steered to the position and alpha the probability of speech. Without speech the likelihood is
    flat over D: the cloud moves by its dynamics alone. The integral is a mean over the centres of a regular
    grid; both terms are densities.

    Args:
        power: Steered power, a module such as `probtrack.audio.SteeredResponsePower`.
        region: Where the talker can be, with as many axes as the tracked position.
        exponent: Initial r; learnable as `log_exponent`. S1 squares the power: r = 2.
        keep_out: No mouth is nearer than this to a microphone [m]. S1 has no such rule (0). A compact array
            needs one: next to it a small step is a large angle, and a talker who walks past is explained best
            by particles that crowd between the microphones.
        grid_points: About how many points the integral is a mean of.
        map_points: About how many cells `evidence_map` has. At 3 kHz a peak is a few cm wide, and cells far larger miss
            it.

    Shape:
        `prepare` takes observations with `gcc` (T, *batch, P, K) and `speech` (T, *batch). Returns (*batch, N).

    References:
        S1 eq. (4) and (5), with gamma normalised over D each frame and the exponent 2 a parameter.
    """

    low: Tensor
    high: Tensor
    cells: Tensor
    cell_size: Tensor

    def __init__(
        self,
        power: TabulatedPower,
        region: Region,
        *,
        exponent: float = 2.0,
        keep_out: float = 0.0,
        grid_points: int = 400,
        map_points: int = 1600,
    ) -> None:
        super().__init__()
        self.power, self.region = power, region
        self.log_exponent = nn.Parameter(as_positive(exponent, "exponent").log())
        grid = region.grid(check_int(grid_points, "grid_points", low=1))
        free = power.distances(grid).amin(-1) >= _checked_keep_out(keep_out)
        if not free.any():
            raise InputError(f"the region holds no place that is keep_out = {keep_out:g} m from every microphone")
        self.keep_out, self.volume = keep_out, region.volume * float(free.double().mean())
        self.power_on_grid = power.at(grid[free])
        cells = region.grid(check_int(map_points, "map_points", low=1))
        size = region.cell_size(map_points)
        # every cell some of which is free
        cells = cells[power.distances(cells).amin(-1) >= keep_out - 0.5 * float(size.norm())]
        self.power_on_map = power.at(cells)
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("cell_size", size, persistent=False)
        self.register_buffer("low", torch.tensor(region.low), persistent=False)
        self.register_buffer("high", torch.tensor(region.high), persistent=False)

    def prepare(self, observations: CorrelationsAndSpeech) -> PreparedPower:
        gcc, speech = observations.gcc, observations.speech[..., None]
        if not ((speech >= 0) & (speech <= 1)).all():
            raise InputError("speech must be a probability in [0, 1]")
        on_grid = self.power_on_grid(gcc)
        scale = on_grid.detach().amax(-1, keepdim=True).clamp_min(_SMALLEST_POWER).reciprocal()
        mean = self._to_the_exponent(scale * on_grid).mean(-1, keepdim=True)
        return PreparedPower(gcc, (1 - speech) / self.volume, scale, speech / (self.volume * mean))

    def evidence_map(self, prepared: PreparedPower) -> EvidenceMap:
        """Return the logarithm of the steered power, without gradient."""
        power = self.power_on_map(prepared.gcc.detach()).clamp_min(_SMALLEST_POWER)
        return EvidenceMap(power.log(), self.cells, self.cell_size)

    def forward(self, observation: PreparedPower, kinematics: Kinematics) -> Tensor:
        position = kinematics.position
        distances = self.power.distances(position)
        power = self._to_the_exponent(observation.scale * self.power.steered(observation.gcc, distances))
        density = torch.addcmul(observation.clutter, observation.target, power)
        # a sharp power may vanish where speech is certain: a logarithm of 0 has no gradient, masked or not
        log_density = density.clamp_min(torch.finfo(density.dtype).tiny).log()
        return torch.where(self._possible(position, distances), log_density, -torch.inf)

    def possible(self, position: Tensor) -> Tensor:
        points = position.reshape(-1, position.shape[-1])
        return self._possible(points, self.power.distances(points)).reshape(position.shape[:-1])

    def _possible(self, position: Tensor, distances: Tensor) -> Tensor:
        inside = (position.clamp(self.low, self.high) == position).all(-1)  # not so for NaN
        return inside & (distances.amin(-1) >= self.keep_out) if self.keep_out > 0 else inside

    def _to_the_exponent(self, power: Tensor) -> Tensor:
        return power.clamp_min(_SMALLEST_POWER).pow(self.log_exponent.exp())


def _checked_keep_out(keep_out: float) -> float:
    if not 0 <= keep_out < float("inf"):
        raise InputError(f"keep_out must be finite and at least 0, got {keep_out}")
    return keep_out
