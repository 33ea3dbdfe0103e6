"""Steered response power at any points, looked up in the cross-correlations of the pairs."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, pad

from probtrack._checks import as_positive, check_int
from probtrack.errors import InputError, ShapeError
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray


class SteeredResponsePower(nn.Module):
    r"""Output power of a beamformer steered to given points, S1 eq. (2), from tabulated correlations.

    .. math:: P(\ell) = \frac1M + \sum_{i<j} R_{ij}\bigl(\tau_i(\ell) - \tau_j(\ell)\bigr), \qquad
              \tau_m(\ell) = \lVert \ell - \ell_m \rVert / c

    in [0, 1] but for rounding: 1 for a single source at the point and no noise, about 1/M for none. R comes
    from `GeneralisedCrossCorrelation` and is interpolated linearly between its lags, which is within 0.5 %
    of steering each frequency (at 3 kHz and 64 000 lags per second) and many times cheaper.

    Args:
        array: The microphones.
        lag_rate: Lags per second of the tables (`GeneralisedCrossCorrelation.lag_rate`) [1/s].
        num_lags: Lags K in a table.
        height: z of points that are given as (x, y), for an array in three dimensions [m]; None takes
            the height of the array's centre.
        speed_of_sound: c [m/s].

    Shape:
        gcc (*observation, P, K), points (*batch, N, A) with `observation` broadcasting against `batch`:
        (runs-of-one recording), (recordings, 1), ... . Returns (*broadcast, N).
    """

    positions: Tensor
    positions_in_plane: Tensor
    steering: Tensor
    rows: Tensor

    def __init__(
        self,
        array: MicrophoneArray,
        *,
        lag_rate: float,
        num_lags: int,
        height: float | None = None,
        speed_of_sound: float = SPEED_OF_SOUND,
    ) -> None:
        super().__init__()
        as_positive(speed_of_sound, "speed_of_sound")
        as_positive(lag_rate, "lag_rate")
        self.num_lags, self.num_pairs = check_int(num_lags, "num_lags", low=2), len(array.pairs)
        self.num_microphones = array.num_microphones
        if height is None:
            height = float(array.centre[2]) if array.axes == 3 else 0.0
        elif not math.isfinite(height):
            raise InputError(f"height must be finite, got {height}")
        self.height = height
        self.in_plane = array.axes == 3 and bool((array.positions[:, 2] == height).all())
        # grid_sample wants (lag, row) in [-1, 1]: one product maps distances to microphones onto both
        steering = torch.zeros(array.num_microphones, self.num_pairs, 2)
        pair = torch.arange(self.num_pairs)
        lag_scale = 2 * lag_rate / (speed_of_sound * (num_lags - 1))
        steering[array.pairs[:, 0], pair, 0] = lag_scale
        steering[array.pairs[:, 1], pair, 0] = -lag_scale
        rows = torch.zeros(self.num_pairs, 2)
        rows[:, 1] = 2 * pair / max(1, self.num_pairs - 1) - 1
        self.register_buffer("positions", array.positions.clone(), persistent=False)
        self.register_buffer("positions_in_plane", array.positions[:, :2].contiguous(), persistent=False)
        self.register_buffer("steering", steering.flatten(1), persistent=False)
        self.register_buffer("rows", rows.flatten(), persistent=False)

    def forward(self, gcc: Tensor, points: Tensor) -> Tensor:
        return self.steered(gcc, self.distances(points))

    def distances(self, points: Tensor) -> Tensor:
        """Return the way from `points` (*batch, N, A) to each microphone, (*batch, N, M) [m]."""
        positions = self.positions
        if points.shape[-1] == 2 and positions.shape[1] == 3:
            if self.in_plane:
                positions = self.positions_in_plane
            else:
                points = pad(points, (0, 1), value=self.height)
        elif points.shape[-1] != positions.shape[1]:
            raise ShapeError(f"points must have shape (..., {positions.shape[1]}), got {tuple(points.shape)}")
        return torch.cdist(points, positions, compute_mode="donot_use_mm_for_euclid_dist")

    def steered(self, gcc: Tensor, distances: Tensor) -> Tensor:
        """Return the power (*broadcast, N) at points that are `distances` (*batch, N, M) [m] from the microphones."""
        if gcc.shape[-2:] != (self.num_pairs, self.num_lags):
            wanted = f"(..., {self.num_pairs}, {self.num_lags})"
            raise ShapeError(f"gcc must have shape {wanted}, got {tuple(gcc.shape)}")
        tables, grid, batch = _aligned(gcc, self._table_coordinates(distances))
        # bilinear between rows that are hit exactly: linear along the lag
        values = grid_sample(tables, grid, mode="bilinear", padding_mode="border", align_corners=True)
        return values.sum(-1).view(*batch, distances.shape[-2]) + 1 / self.num_microphones

    def at(self, points: Tensor) -> "FixedSteeredResponsePower":
        """Return the steered power at `points` (G, A) that stay the same from frame to frame."""
        lag, row = self._table_coordinates(self.distances(points)).unbind(-1)
        lags = ((lag.clamp(-1, 1) + 1) / 2 * (self.num_lags - 1)).round()
        rows = ((row + 1) / 2 * (self.num_pairs - 1)).round()
        entries = (rows * self.num_lags + lags).long().t()
        return FixedSteeredResponsePower(entries, num_microphones=self.num_microphones)

    def _table_coordinates(self, distances: Tensor) -> Tensor:
        """Return where the delays of points lie in the tables, (*batch, N, P, 2), given their distances."""
        coordinates = torch.addmm(self.rows, distances.view(-1, self.num_microphones), self.steering)
        return coordinates.view(*distances.shape[:-1], self.num_pairs, 2)


class FixedSteeredResponsePower(nn.Module):
    """Steered power at points that stay the same, by the nearest lag: for integrals and maps over a region.

    Made by `SteeredResponsePower.at`. Rounding the lags costs up to 0.04 of the largest power at a point for two
    microphones, about 0.01 for eight, and far less in a mean over points; it makes a table entry of each delay
    once and for all.

    Args:
        entries: Where each pair's delay at each point is in the flattened tables, (P, G).
        num_microphones: M.

    Shape:
        gcc (..., P, K). Returns (..., G).
    """

    entries: Tensor

    def __init__(self, entries: Tensor, *, num_microphones: int) -> None:
        super().__init__()
        self.num_microphones = num_microphones
        self.register_buffer("entries", entries.contiguous(), persistent=False)

    def forward(self, gcc: Tensor) -> Tensor:
        values = gcc.reshape(-1, gcc.shape[-2] * gcc.shape[-1]).index_select(1, self.entries.flatten())
        power = values.view(-1, *self.entries.shape).sum(1) + 1 / self.num_microphones
        return power.view(*gcc.shape[:-2], self.entries.shape[1])


def _aligned(gcc: Tensor, grid: Tensor) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Return tables (B, 1, P, K), coordinates (B, n, P, 2) and the batch, copying neither if it can be.

    Trailing batch axes along which the observation does not vary (Monte-Carlo runs) become more points.
    """
    points = grid.shape[:-3]
    if gcc.ndim == 2:  # one recording: all batch axes are runs
        return gcc[None, None], grid.view(1, -1, *grid.shape[-2:]), points
    batch = torch.broadcast_shapes(gcc.shape[:-2], points)
    observed = (1,) * (len(batch) - gcc.ndim + 2) + gcc.shape[:-2]
    lead = max((axis + 1 for axis, size in enumerate(observed) if size > 1), default=0)
    outer = batch[:lead]
    tables = gcc.reshape(*observed[:lead], *gcc.shape[-2:]).expand(*outer, *gcc.shape[-2:])
    tables = tables.reshape(-1, 1, *gcc.shape[-2:])
    grid = grid.expand(*batch, *grid.shape[-3:])
    return tables, grid.reshape(tables.shape[0], -1, *grid.shape[-2:]), batch
