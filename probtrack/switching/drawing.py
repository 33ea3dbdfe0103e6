"""Drawing modes from standard normal numbers, with the weights that carry a chain's gradient."""

from collections.abc import Callable

import torch
from torch import Tensor

from probtrack.errors import ShapeError

Draw = Callable[[Tensor, Tensor], tuple[Tensor, Tensor | None]]
"""`(mode before (*batch, N), standard normal numbers (*batch, N)) -> (mode, log weight or None)`; modes are whole
numbers of floating type."""


def drawn_from(table: Tensor, explore: float) -> Draw:
    """Return what draws the next mode by log probabilities `table` (*batch, S + 1, S), rows by the mode before.

    Args:
        table: Axes of size 1 in its batch are shared.
        explore: Share of modes drawn evenly from all possible ones; the weights p / q correct for it.
    """
    law = _explored(table.detach(), explore)
    bounds = _thresholds(law)
    if (bounds == bounds[..., :1, :]).all():  # one law whatever was before: S1 eq. 32
        bounds = bounds[..., :1, :]
    weighted = explore > 0 or (torch.is_grad_enabled() and table.requires_grad)

    def draw(before: Tensor, normal: Tensor) -> tuple[Tensor, Tensor | None]:
        shared, batch = table.shape[:-2], before.shape[:-1]
        if any(n not in (1, m) for n, m in zip(reversed(shared), reversed(batch), strict=False)):
            raise ShapeError(f"speech must have the belief's batch {tuple(batch)}, got {tuple(shared)}")
        # 1 where the number is above, and 0 elsewhere: comparisons to bool take five times as long
        bound_of = [bound if bound.shape[-1] == 1 else _looked_up(bound, before) for bound in bounds.unbind(-1)]
        above = [(normal - bound).sign().clamp_min(0) for bound in bound_of]
        after = torch.zeros_like(before) if not above else sum(above[1:], above[0])
        if not weighted:
            return after, None
        pair = before * table.shape[-1] + after
        return after, _looked_up(table.flatten(-2), pair) - _looked_up(law.flatten(-2), pair)

    return draw


def _explored(table: Tensor, share: float) -> Tensor:
    """Return the log probabilities (..., S) that modes are drawn from: evenly from all possible ones in a `share`."""
    if share == 0:
        return table
    possible = (table > -torch.inf).to(table)
    return ((1 - share) * table.exp() + share * possible / possible.sum(-1, keepdim=True)).log()


def _thresholds(table: Tensor) -> Tensor:
    """Return what a standard normal number must exceed for each next mode (..., S - 1), +-inf for impossible ones."""
    p = table.exp()
    below = p.cumsum(-1)[..., :-1]
    above = p.flip(-1).cumsum(-1).flip(-1)[..., 1:]
    # from the nearer end, so that a sum that misses 1 by rounding leaves no room for an impossible mode
    return torch.where(below < above, torch.special.ndtri(below), -torch.special.ndtri(above))


def _looked_up(table: Tensor, index: Tensor) -> Tensor:
    """Return `table` (*batch, R) at whole numbers `index` (*batch, N); batch axes of size 1 are shared."""
    rows = index.int()
    if table.ndim > 1:
        batch, size = index.shape[:-1], table.shape[-1]
        starts = torch.arange(0, batch.numel() * size, size, dtype=torch.int32, device=index.device)
        rows = rows + starts.view(*batch, 1)
        table = table.expand(*batch, size)
    return table.flatten().index_select(0, rows.flatten()).view(index.shape)
