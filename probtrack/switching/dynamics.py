"""A talker who changes between ways of moving."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from probtrack._checks import check_event
from probtrack.distributions import Switched
from probtrack.dynamics import Dynamics, Kinematics, Move, Transition
from probtrack.errors import InputError
from probtrack.switching.chain import MarkovChain, one_time_step


class SwitchingDynamics(Dynamics):
    r"""Motion by one of S models at a time, which a Markov chain picks anew in each frame:

    .. math:: p(X_t, s_t \mid X_{t-1}, s_{t-1}) = P(s_t \mid s_{t-1})\, p_{s_t}(X_t \mid X_{t-1}) .

    Every particle has its mode in its state. The models may have different states: a particle that changes its
    mode keeps its `Kinematics` and no more (an acceleration starts at 0).

    Modes are drawn and never relaxed. Gradients reach the chain by importance weights: a mode is drawn from a law q
    that is taken as fixed, and the particle is weighted by p / q, which is 1 for `explore` = 0 but carries the
    gradient of log p.

    Args:
        models: S motion models with the same number of axes.
        chain: Law of the modes.
        explore: Share of particles whose mode is drawn evenly from all that are possible, in [0, 1); their
            weights correct for it. Some exploration keeps a rare mode from being forgotten while a chain is
            learned; 0 draws from the chain itself, as a plain filter does.

    Shape:
        state (..., D): the state of the particle's own model, padded with zeros to the largest, then the mode,
        0 to S - 1, or S before the first frame, when the state is that of the first model. One `dt` for all.

    References:
        S1 section 3.3, eq. 32 and Figure 2. S. McGinnity, G. Irwin, "Multiple model bootstrap filter for
        maneuvering target tracking", IEEE Trans. Aerospace and Electronic Systems 36(3):1006-1012, 2000.
        J. Brady et al., "Differentiable interacting multiple model particle filtering", arXiv 2410.00620, 2024:
        learning by importance weights.

    >>> from probtrack.dynamics import lehmann2007
    >>> models = [lehmann2007("CU-LAN"), lehmann2007("CL-RWVE-RAAC")]
    >>> model = SwitchingDynamics(models, MarkovChain.dwelling([2.0, 1.0]))
    >>> state = model.from_kinematics(Kinematics(torch.zeros(7, 2), torch.ones(7, 2)))
    >>> model.transition(0.032)(state, torch.randn(7, model.noise_dim)).shape
    torch.Size([7, 6])
    """

    def __init__(self, models: Sequence[Dynamics], chain: MarkovChain, *, explore: float = 0.0) -> None:
        super().__init__()
        if len(models) != chain.num_modes:
            raise InputError(f"models must be as many as the modes of the chain, {chain.num_modes}, got {len(models)}")
        axes = [model.axes for model in models]
        if len(set(axes)) > 1:
            raise InputError(f"models must have one number of axes, got {', '.join(map(str, axes))}")
        if not 0 <= explore < 1:
            raise InputError(f"explore must be in [0, 1), got {explore}")
        self.models, self.chain, self.explore = nn.ModuleList(models), chain, float(explore)
        self.axes, self.num_modes = axes[0], len(models)
        self._parts: list[Dynamics] = list(models)  # nn.ModuleList forgets the type, and is slow to walk
        self.state_dim = max(model.state_dim for model in models) + 1
        self.noise_dim = max(model.noise_dim for model in models) + 1

    def forward(self, state: Tensor, dt: float | Tensor) -> Switched:
        """Return the law of the next state over `dt`.

        Raises:
            InputError: if the chain listens: the law then depends on the frame's speech, see `moves`.
        """
        check_event(state, (self.state_dim,), "state")
        before = state[..., -1].long()
        rows = self.chain(one_time_step(dt))[before]
        layout = self._layout(before)
        flat, of = _flat(state[..., :-1]), layout.flatten()
        laws = []
        for s, model in enumerate(self._parts):
            own = self._carried(flat, of, torch.full_like(of, s))[: model.state_dim]
            laws.append(model(own.view(-1, *layout.shape).movedim(0, -1), dt))
        return Switched(rows, laws)

    def transition(self, dt: float | Tensor) -> Transition:
        """Return the step by the chain itself, without exploring and without its gradient; see `moves`."""
        move = self._move(self.chain(one_time_step(dt)).detach(), dt, explore=0.0)
        return lambda state, noise: move(state, noise)[0]

    def moves(self, observations: Any, dt: float | Tensor) -> Iterable[Move]:
        """Return the step into each frame; a chain that listens reads `observations.speech` (T, *batch).

        Raises:
            InputError: for observations without speech, if the chain listens.
        """
        if not self.chain.listens:
            return itertools.repeat(self._move(self.chain(one_time_step(dt)), dt, explore=self.explore))
        speech = getattr(observations, "speech", None)
        if speech is None:
            raise InputError("observations must have `speech` for a chain that listens to it")
        tables = self.chain(one_time_step(dt), speech)
        transitions = [model.transition(dt) for model in self._parts]
        return (self._move(table, dt, transitions, explore=self.explore) for table in tables.unbind(0))

    def mode(self, state: Tensor) -> Tensor:
        """Return ones and zeros (..., S): which model moved each particle last."""
        mode = state[..., -1]
        return torch.stack([mode == s for s in range(self.num_modes)]).to(state).movedim(0, -1)

    def kinematics(self, state: Tensor) -> Kinematics:
        check_event(state, (self.state_dim,), "state")
        layout = self._layout(state[..., -1])
        each = [model.kinematics(state[..., : model.state_dim]) for model in self._parts]
        position, velocity = each[0].position, each[0].velocity
        heading = each[0].modelled_heading
        modelled = any(k.modelled_heading is not None for k in each)
        if modelled:
            heading = each[0].heading
        for s, k in enumerate(each[1:], 1):
            here = layout == s
            position = _where(here[..., None], k.position, position)
            velocity = _where(here[..., None], k.velocity, velocity)
            if modelled and heading is not None:
                heading = torch.where(here, k.heading, heading)
        return Kinematics(position, velocity, heading)

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        """Return the state (..., D) of a talker before the first frame, whose mode is still to be drawn."""
        known = self._parts[0].from_kinematics(kinematics)
        padded = torch.nn.functional.pad(known, (0, self.state_dim - 1 - known.shape[-1]))
        return torch.nn.functional.pad(padded, (0, 1), value=self.num_modes)

    def _move(
        self, table: Tensor, dt: float | Tensor, transitions: Sequence[Transition] | None = None, *, explore: float
    ) -> Move:
        """Return the step whose modes have log probabilities `table` (*batch, S + 1, S)."""
        steps = [model.transition(dt) for model in self._parts] if transitions is None else transitions
        drawn_from = _explored(table.detach(), explore)
        bounds = _thresholds(drawn_from)
        weighted = explore > 0 or (torch.is_grad_enabled() and table.requires_grad)

        def move(state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor | None]:
            check_event(state, (self.state_dim,), "state")
            check_event(noise, (self.noise_dim,), "noise")
            shape = torch.broadcast_shapes(state.shape[:-1], noise.shape[:-1])
            state, noise = state.expand(*shape, -1), noise.expand(*shape, -1)
            before = state[..., -1].long()
            after = sum(
                (noise[..., -1] > _looked_up(bounds[..., j], before)).long() for j in range(self.num_modes - 1)
            ) + torch.zeros_like(before)
            moved = self._moved(state, noise, before, after, steps)
            if not weighted:
                return moved, None
            pair = before * self.num_modes + after
            log_p = _looked_up(table.flatten(-2), pair)
            return moved, log_p - _looked_up(drawn_from.flatten(-2), pair)

        return move

    def _moved(
        self, state: Tensor, noise: Tensor, before: Tensor, after: Tensor, steps: Sequence[Transition]
    ) -> Tensor:
        flat, numbers = _flat(state[..., :-1]), _flat(noise)
        of, to = self._layout(before).flatten(), after.flatten()
        flat = self._carried(flat, of, to)
        out = flat.new_zeros(self.state_dim, flat.shape[1])
        for s, (model, step) in enumerate(zip(self._parts, steps, strict=True)):
            # only the particles of a mode go through its model: another's state may be beyond its domain
            which = (to == s).nonzero()[:, 0]
            if len(which) > 0:
                own = flat[: model.state_dim].index_select(1, which)
                numbers_of = numbers[: model.noise_dim].index_select(1, which)
                out[: model.state_dim].index_copy_(1, which, step(own.mT, numbers_of.mT).mT)
        out[-1] = to
        return out.view(-1, *after.shape).movedim(0, -1)

    def _carried(self, flat: Tensor, of: Tensor, to: Tensor) -> Tensor:
        """Return states (D - 1, n) that are laid out as model `of` (n,) has it, laid out as model `to` has it."""
        changed = (of != to).nonzero()[:, 0]
        if len(changed) == 0:
            return flat
        some, old, new = flat.index_select(1, changed), of[changed], to[changed]
        carried = torch.zeros_like(some)
        for i, giver in enumerate(self._parts):
            for j, taker in enumerate(self._parts):
                which = ((old == i) & (new == j)).nonzero()[:, 0]
                if len(which) > 0:
                    kinematics = giver.kinematics(some[: giver.state_dim].index_select(1, which).mT)
                    carried[: taker.state_dim].index_copy_(1, which, taker.from_kinematics(kinematics).mT)
        return flat.index_copy(1, changed, carried)

    def _layout(self, mode: Tensor) -> Tensor:
        """Return whose layout a state has: that of its mode's model, and of the first before the first frame."""
        return torch.where(mode == self.num_modes, torch.zeros_like(mode), mode)


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
    """Return `table` (*batch, R) at `index` (*batch, N); axes of size 1 in the table's batch are shared."""
    if table.ndim == 1:
        return table.take(index)
    return table.expand(*index.shape[:-1], -1).gather(-1, index)


def _where(here: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return `a` where `here`, else `b`; at once if both are one piece of memory, as for models of one layout."""
    try:
        same = a.data_ptr() == b.data_ptr() and a.stride() == b.stride()
    except RuntimeError:  # tensors of torch.func have no memory to ask for
        same = False
    return b if same else torch.where(here, a, b)


def _flat(vectors: Tensor) -> Tensor:
    """Return vectors (..., D) variables first, (D, n)."""
    variables = vectors.movedim(-1, 0)
    return variables.reshape(len(variables), -1)
