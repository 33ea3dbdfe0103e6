"""Finding a lost talker again: some particles go where the frame's own evidence is."""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from probtrack._checks import as_positive
from probtrack.dynamics import Dynamics, Kinematics
from probtrack.errors import InputError, ShapeError
from probtrack.likelihoods import EvidenceMap

_FLAT = 0.1  # share of the map that is even: no weight exceeds ten times what an even map would give

Relocate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor | None]]
"""Into one frame: `(state (*batch, N, D), standard normal numbers (*batch, N, K))` to the new states before they move,
the log weights (*batch, N) that correct for how they were drawn, and log q (*batch, N) with the gradient of the
proposal, or None where nobody asks for one."""


class Relocation(nn.Module):
    r"""A talker may be somewhere else all of a sudden, and is looked for where the sound comes from.

    The model: before a frame of length T a talker leaves for a place anywhere in the region with the probability

    .. math:: \pi_t = 1 - e^{-\lambda_t T}, \qquad \lambda_t = \alpha_t \lambda_\text{speech} + (1 - \alpha_t)
        \lambda_\text{silence}

    (someone else speaks, or the filter had lost the talker), then moves as ever. The proposal: with the probability
    :math:`\varepsilon_t`, mixed by speech in the same way, a particle is drawn from the map of the frame's evidence,

    .. math:: g_t(\ell) \propto P_t(\ell)^s \quad\text{(nine tenths, the rest even)}, \qquad
        w = \frac{\pi_t\, \mathcal U(\ell)}{\varepsilon_t\, g_t(\ell)}
        \quad\text{or else}\quad w = \frac{1 - \pi_t}{1 - \varepsilon_t} .

    The weights make the evidence that of the model, whatever the share and the map. The model's rates are trained by
    any loss. Share and map do not change what a filter says on average, only how well: their gradient is that of
    `ProposalLoss`, by which the proposal follows the posterior law of who left and for where.

    Args:
        rate: Initial relocations a second of speech; learnable as `log_rate`.
        rate_silence: The same in silence; learnable as `log_rate_silence`.
        share: Initial share of particles drawn from the map in speech, in (0, 1); learnable as `logit_share`.
        share_silence: The same in silence; learnable as `logit_share_silence`.
        sharpness: Initial s; learnable as `log_sharpness`.
        speed: Root mean square speed of a talker at the new place on each axis [m/s]; learnable as `log_speed`.

    References:
        S. Thrun, D. Fox, W. Burgard, F. Dellaert, "Robust Monte Carlo localization for mobile robots", Artificial
        Intelligence 128, 2001: particles drawn from the evidence, there with approximate weights. T. Hesterberg,
        "Weighted average importance sampling and defensive mixture distributions", Technometrics 37(2), 1995.
        S. Gu, Z. Ghahramani, R. E. Turner, "Neural adaptive sequential Monte Carlo", NeurIPS 2015, eq. 6: the gradient
        of the proposal.
    """

    def __init__(
        self,
        *,
        rate: float = 0.3,
        rate_silence: float = 0.03,
        share: float = 0.05,
        share_silence: float = 0.002,
        sharpness: float = 4.0,
        speed: float = 0.5,
    ) -> None:
        super().__init__()
        self.log_rate = nn.Parameter(as_positive(rate, "rate").log())
        self.log_rate_silence = nn.Parameter(as_positive(rate_silence, "rate_silence").log())
        self.logit_share = nn.Parameter(_share(share, "share").logit())
        self.logit_share_silence = nn.Parameter(_share(share_silence, "share_silence").logit())
        self.log_sharpness = nn.Parameter(as_positive(sharpness, "sharpness").log())
        self.log_speed = nn.Parameter(as_positive(speed, "speed").log())

    def noise_dim(self, axes: int) -> int:
        """Return how many standard normal numbers a particle needs a frame: for who goes where, place and velocity."""
        return 1 + 2 * axes

    def forward(
        self, dynamics: Dynamics, evidence: EvidenceMap, speech: Tensor | None, dt: float | Tensor
    ) -> Iterator[Relocate]:
        """Yield the step before each frame's motion.

        Args:
            dynamics: Lays out the states.
            evidence: Of T frames.
            speech: P(speech) (T, *batch); 1 throughout if None.
            dt: Time step [s], one number, (T,) or (T, *batch).
        """
        log_leave, log_stay, share = self._probabilities(evidence, speech, dt)
        even = 1 / evidence.log_evidence.shape[-1]
        cells = (1 - _FLAT) * (self.log_sharpness.exp() * evidence.log_evidence).softmax(-1) + _FLAT * even
        log_cells, log_even = cells.log(), math.log(even)
        steps = cells.detach().cumsum(-1)
        ends = (steps / steps[..., -1:]).unbind(0)
        for t, (cell_ends, log_cell) in enumerate(zip(ends, log_cells.unbind(0), strict=True)):
            yield self._relocate(dynamics, evidence, cell_ends, log_cell, log_even, log_leave[t], log_stay[t], share[t])

    def _probabilities(
        self, evidence: EvidenceMap, speech: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return log pi, log(1 - pi) and the logit of epsilon of each frame, (T, *batch, 1)."""
        if speech is None:
            speech = torch.ones(evidence.log_evidence.shape[:-1]).to(evidence.log_evidence)
        if speech.shape != evidence.log_evidence.shape[:-1]:
            raise ShapeError(
                f"speech must have shape {tuple(evidence.log_evidence.shape[:-1])}, got {tuple(speech.shape)}"
            )
        rate = torch.lerp(self.log_rate_silence.exp(), self.log_rate.exp(), speech)
        if isinstance(dt, Tensor) and 0 < dt.ndim < rate.ndim:
            dt = dt.reshape(-1, *[1] * (rate.ndim - 1))
        left = rate * dt
        share = torch.lerp(self.logit_share_silence.sigmoid(), self.logit_share.sigmoid(), speech)
        return (-torch.expm1(-left)).log()[..., None], -left[..., None], share.logit()[..., None]

    def _relocate(
        self,
        dynamics: Dynamics,
        evidence: EvidenceMap,
        ends: Tensor,
        log_cell: Tensor,
        log_even: float,
        log_leave: Tensor,
        log_stay: Tensor,
        logit_share: Tensor,
    ) -> Relocate:
        axes = evidence.centre.shape[-1]
        log_share, log_rest = logsigmoid(logit_share), logsigmoid(-logit_share)
        share = log_share.detach().exp()
        stays = log_stay - log_rest.detach()
        leaves = log_leave - log_share.detach() + log_even
        wants_proposal = torch.is_grad_enabled() and logit_share.requires_grad

        def relocate(state: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
            uniform = torch.special.ndtr(normal[..., 0])
            goes = (share - uniform).sign().clamp_min(0)  # 1 or 0: comparisons to bool and choices by them take longer
            # what is left of the number, uniform again among those who go, finds the cell
            cell = _first_beyond(ends, (uniform / share).clamp_max(1 - torch.finfo(uniform.dtype).eps))
            within = torch.special.ndtr(normal[..., 1 : 1 + axes]) - 0.5
            place = evidence.centre[cell] + evidence.size * within
            velocity = self.log_speed.exp() * normal[..., 1 + axes : 1 + 2 * axes]
            there = dynamics.from_kinematics(Kinematics(place, velocity))
            log_cell_there = _looked_up(log_cell, cell)
            log_weight = torch.lerp(stays.expand_as(goes), leaves - log_cell_there.detach(), goes)
            log_q = torch.lerp(log_rest.expand_as(goes), log_share + log_cell_there, goes) if wants_proposal else None
            # variables first in memory, as clouds lie
            moved = torch.lerp(state.movedim(-1, 0), there.movedim(-1, 0), goes)
            return moved.movedim(0, -1), log_weight, log_q

        return relocate


def _share(value: float, name: str) -> Tensor:
    if not 0 < value < 1:
        raise InputError(f"{name} must be in (0, 1), got {value}")
    return as_positive(value, name)


def _first_beyond(ends: Tensor, uniform: Tensor) -> Tensor:
    """Return the first of G cells whose end (*batch, G) is beyond `uniform` (*batch, N); batch axes of 1 are shared."""
    last = ends.shape[-1] - 1
    if ends.numel() == last + 1:
        return torch.searchsorted(ends.flatten(), uniform, right=True).clamp_max(last)
    ends = ends.expand(*uniform.shape[:-1], -1).contiguous()
    return torch.searchsorted(ends, uniform.contiguous(), right=True).clamp_max(last)


def _looked_up(table: Tensor, index: Tensor) -> Tensor:
    """Return `table` (*batch, G) at `index` (*batch, N); batch axes of 1 are shared."""
    return (
        table.flatten()[index]
        if table.numel() == table.shape[-1]
        else table.expand(*index.shape[:-1], -1).gather(-1, index)
    )
