"""Finding a lost talker again: some particles go where the frame's own evidence is."""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive
from probtrack.dynamics import Dynamics, Kinematics
from probtrack.errors import InputError, ShapeError
from probtrack.likelihoods import EvidenceMap

_FLAT = 0.1  # share of the map that is even: no weight exceeds ten times what an even map would give

_LEAST = 1e-12  # of a probability whose logarithm is taken

Relocate = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor | None]]
"""Into one frame: `(state (*batch, N, D), log weights (*batch, N), standard normal numbers (*batch, N, K))` to the new
states before they move, the log weights (*batch, N) that correct for how they were drawn, and log q (*batch, N) with
the gradient of the proposal, or None where nobody asks for one."""


class Relocation(nn.Module):
    r"""A talker may have gone another way than the motion model knows, and is looked for where the sound comes from.

    The model: before a frame of length T a talker is displaced, and moves at any speed, with the probability

    .. math:: \pi_t = 1 - e^{-\lambda_t T}, \qquad \lambda_t = \alpha_t \lambda_\text{speech} + (1 - \alpha_t)
        \lambda_\text{silence}, \qquad \ell' \sim \mathcal N(\ell, s^2 I),

    then moves as ever: a turn in a pause, or a filter that had lost the talker. The proposal: with the probability
    :math:`\varepsilon_t`, mixed by speech in the same way, a particle goes to a cell of the map of what was heard,

    .. math:: M_t = e^{-T/\tau} M_{t-1} + \alpha_t \log P_t, \qquad
        g_t(\ell') \propto e^{a M_t(\ell')}\, \mathcal N(\ell'; m, V + s^2)
        \quad\text{(nine tenths, the rest without M)},

    within reach of the cloud, whose mean is m and whose variances are V. (The largest power of one frame is often at an
    echo; the sum over a quarter of a second is at the talker.) The weights

    .. math:: w = \frac{\pi_t\, \mathcal N(\ell'; \ell, s^2)}{\varepsilon_t\, g_t(\ell')}
        \quad\text{or else}\quad w = \frac{1 - \pi_t}{1 - \varepsilon_t}

    make the evidence that of the model, whatever the share and the map. Rates, spread and speed of the model are
    trained by any loss. Share and sharpness do not change what a filter says on average, only how well: their
    gradient is that of `ProposalLoss`, by which the proposal follows the posterior law of who went where.

    Args:
        rate: Initial relocations a second of speech; learnable as `log_rate`.
        rate_silence: The same in silence; learnable as `log_rate_silence`.
        spread: Initial s, of a displacement on each axis [m]; learnable as `log_spread`.
        speed: Root mean square speed of a talker at the new place on each axis [m/s]; learnable as `log_speed`.
        share: Initial share of particles drawn from the map in speech, in (0, 1); learnable as `logit_share`.
        share_silence: The same in silence; learnable as `logit_share_silence`.
        sharpness: Initial a; learnable as `log_sharpness`.
        memory: Initial tau [s]; learnable as `log_memory`.

    References:
        S. Thrun, D. Fox, W. Burgard, F. Dellaert, "Robust Monte Carlo localization for mobile robots", Artificial
        Intelligence 128, 2001: particles drawn from the evidence, there with approximate weights. T. Hesterberg,
        "Weighted average importance sampling and defensive mixture distributions", Technometrics 37(2), 1995.
        S. Gu, Z. Ghahramani, R. E. Turner, "Neural adaptive sequential Monte Carlo", NeurIPS 2015: the gradient of the
        proposal.
    """

    def __init__(
        self,
        *,
        rate: float = 0.5,
        rate_silence: float = 0.1,
        spread: float = 0.4,
        speed: float = 0.5,
        share: float = 0.1,
        share_silence: float = 0.01,
        sharpness: float = 6.0,
        memory: float = 0.25,
    ) -> None:
        super().__init__()
        self.log_rate = nn.Parameter(as_positive(rate, "rate").log())
        self.log_rate_silence = nn.Parameter(as_positive(rate_silence, "rate_silence").log())
        self.log_spread = nn.Parameter(as_positive(spread, "spread").log())
        self.log_speed = nn.Parameter(as_positive(speed, "speed").log())
        self.logit_share = nn.Parameter(_share(share, "share").logit())
        self.logit_share_silence = nn.Parameter(_share(share_silence, "share_silence").logit())
        self.log_sharpness = nn.Parameter(as_positive(sharpness, "sharpness").log())
        self.log_memory = nn.Parameter(as_positive(memory, "memory").log())

    def noise_dim(self, axes: int) -> int:
        """Return how many standard normal numbers a particle needs a frame: for who goes where, place and velocity."""
        return 1 + 2 * axes

    def forward(
        self,
        dynamics: Dynamics,
        evidence: EvidenceMap,
        speech: Tensor | None,
        dt: float | Tensor,
        heard: Tensor | None = None,
    ) -> tuple[Iterator[Relocate], Tensor]:
        """Return the step before each frame's motion, and what is remembered of the evidence after the last frame.

        Args:
            dynamics: Lays out the states.
            evidence: Of T frames.
            speech: P(speech) (T, *batch); 1 throughout if None.
            dt: Time step [s], one number, (T,) or (T, *batch).
            heard: What was remembered after the frame before (*batch, G); nothing if None.
        """
        maps = evidence.log_evidence
        if speech is None:
            speech = torch.ones(maps.shape[:-1]).to(maps)
        if speech.shape != maps.shape[:-1]:
            raise ShapeError(f"speech must have shape {tuple(maps.shape[:-1])}, got {tuple(speech.shape)}")
        if isinstance(dt, Tensor) and 0 < dt.ndim < speech.ndim:
            dt = dt.reshape(-1, *[1] * (speech.ndim - 1))
        kept = torch.as_tensor(-dt / self.log_memory.exp()).exp().expand_as(speech)[..., None]
        total, totals = torch.zeros_like(maps[0]) if heard is None else heard, []
        for decay, frame in zip(kept.unbind(0), (speech[..., None] * maps).unbind(0), strict=True):
            total = torch.addcmul(frame, decay, total)
            totals.append(total)
        chances = (x[..., None].unbind(0) for x in self._probabilities(speech, dt))
        frames = zip(totals, *chances, strict=True)
        return (self._relocate(dynamics, evidence, *frame) for frame in frames), total

    def _probabilities(self, speech: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log pi, log(1 - pi) and epsilon of each frame, (T, *batch)."""
        rate = torch.lerp(self.log_rate_silence.exp(), self.log_rate.exp(), speech)
        left = rate * dt
        share = torch.lerp(self.logit_share_silence.sigmoid(), self.logit_share.sigmoid(), speech)
        return (-torch.expm1(-left)).clamp_min(_LEAST).log(), -left, share

    def _relocate(
        self,
        dynamics: Dynamics,
        evidence: EvidenceMap,
        total: Tensor,
        log_leave: Tensor,
        log_stay: Tensor,
        share: Tensor,
    ) -> Relocate:
        axes, sharpened = evidence.centre.shape[-1], self.log_sharpness.exp() * total
        log_share, log_rest = share.log(), torch.log1p(-share)
        variance, log_area = (2 * self.log_spread).exp(), evidence.size.log().sum()
        stays = log_stay - log_rest.detach()
        leaves = log_leave - log_share.detach()
        wants_proposal = torch.is_grad_enabled() and share.requires_grad

        def relocate(state: Tensor, log_weight: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
            position = dynamics.kinematics(state).position
            cells = _within_reach(sharpened, _near(position.detach(), log_weight.detach(), variance, evidence.centre))
            chance = share.detach()
            uniform = torch.special.ndtr(normal[..., 0])
            goes = (chance - uniform).sign().clamp_min(0)  # 1 or 0: bools and choices by them take longer
            # what is left of the number, uniform again among those who go, finds the cell
            cell = _first_beyond(cells.detach().cumsum(-1), uniform / chance, goes)
            within = torch.special.ndtr(normal[..., 1 : 1 + axes]) - 0.5
            place = evidence.centre[cell] + evidence.size * within
            velocity = self.log_speed.exp() * normal[..., 1 + axes : 1 + 2 * axes]
            there = dynamics.from_kinematics(Kinematics(place, velocity))
            log_cell = cells.gather(-1, cell).clamp_min(_LEAST).log() - log_area
            prior = _log_normal(place, position, variance)
            log_correction = torch.lerp(stays.expand_as(goes), leaves + prior - log_cell.detach(), goes)
            log_q = torch.lerp(log_rest.expand_as(goes), log_share + log_cell, goes) if wants_proposal else None
            # variables first in memory, as clouds lie
            moved = torch.lerp(state.movedim(-1, 0), there.movedim(-1, 0), goes)
            return moved.movedim(0, -1), log_correction, log_q

        return relocate


def _near(position: Tensor, log_weight: Tensor, variance: Tensor, centre: Tensor) -> Tensor:
    """Return the log density (*batch, G) of cells about the mean of the cloud, up to a constant of the cloud.

    A product of what depends on the cloud and what depends on the cells: axis by axis it takes a hundred times as long.
    """
    weight = log_weight.exp()[..., None]
    mean = (weight * position).sum(-2)
    precision = 1 / ((weight * (position - mean[..., None, :]).square()).sum(-2) + variance)
    origin = centre.mean(0)  # so that squares are small
    away = centre - origin
    of_cells = torch.cat([-0.5 * away.square(), away], -1)
    return torch.cat([precision, precision * (mean - origin)], -1) @ of_cells.mT


def _within_reach(sharpened: Tensor, near: Tensor) -> Tensor:
    """Return the probabilities (*batch, G) of cells: what the map says (*batch, G), within reach of the cloud."""
    return torch.lerp((sharpened + near).softmax(-1), near.softmax(-1), _FLAT)


def _log_normal(value: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """Return the log density (...) of `value` (..., A) under independent normal laws of one variance."""
    axes = value.shape[-1]
    return -0.5 * ((value - mean).square().sum(-1) / variance + axes * (variance.log() + math.log(2 * math.pi)))


def _share(value: float, name: str) -> Tensor:
    if not 0 < value < 1:
        raise InputError(f"{name} must be in (0, 1), got {value}")
    return as_positive(value, name)


def _first_beyond(ends: Tensor, uniform: Tensor, goes: Tensor) -> Tensor:
    """Return the first of G cells whose end (*batch, G) is beyond `uniform` (*batch, N); any cell for who does not go.

    Few go, and a search takes longer than all the rest: only as many are looked up in each cloud as go in the fullest.
    """
    most = int(goes.sum(-1).max()) if goes.numel() else 0
    who = goes.topk(most, -1, sorted=False).indices
    found = torch.searchsorted(ends.contiguous(), uniform.gather(-1, who), right=True)
    cells = torch.zeros(goes.shape, dtype=torch.long, device=goes.device)
    return cells.scatter_(-1, who, found.clamp_max_(ends.shape[-1] - 1))
