"""A talker who changes between ways of moving."""

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from probtrack._checks import check_event
from probtrack.distributions import Switched
from probtrack.dynamics import Dynamics, Kinematics, Move, Transition
from probtrack.dynamics.base import checked_axes
from probtrack.errors import InputError, ShapeError
from probtrack.switching.chain import MarkovChain
from probtrack.switching.drawing import drawn_from


class SwitchingDynamics(Dynamics):
    r"""Motion by one of S models at a time, which a Markov chain picks anew in each frame:

    .. math:: p(X_t, s_t \mid X_{t-1}, s_{t-1}) = P(s_t \mid s_{t-1})\, p_{s_t}(X_t \mid X_{t-1}) .

    Every particle has its mode in its state. The models may have different states: a particle that changes its
    mode keeps its `Kinematics` and no more (an acceleration starts at 0), or all of its state if the models
    have one `layout`.

    Modes are drawn and never relaxed. Gradients reach the chain by importance weights: a mode is drawn from a law q
    that is taken as fixed, and the particle is weighted by p / q, which is 1 for `explore` = 0 but carries the
    gradient of log p. To learn a chain from the filter's evidence, resample by `StopGradient`: copies of equal weight
    forget the gradient of all weights before, which is most of the chain's.

    Args:
        models: S motion models with the same number of axes.
        chain: Law of the modes.
        explore: Share of particles whose mode is drawn evenly from all that are possible, in [0, 1); their
            weights correct for it. Some exploration keeps a rare mode from being forgotten while a chain is
            learned; 0 draws from the chain itself, as a plain filter does.

    Shape:
        state (..., D): the state of the particle's own model, padded with zeros to the largest, then the mode,
        0 to S - 1, or S before the first frame, when the state is that of the first model. dt: float or (...) [s]; in
        steps the same for all particles of a cloud, (*batch, 1).

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
        axes = [checked_axes(model) for model in models]
        if len(set(axes)) > 1:
            raise InputError(f"models must have one number of axes, got {', '.join(map(str, axes))}")
        if not 0 <= explore < 1:
            raise InputError(f"explore must be in [0, 1), got {explore}")
        self.models, self.chain, self.explore = nn.ModuleList(models), chain, float(explore)
        self.axes, self.num_modes = axes[0], len(models)
        self._alike = len(models) == 1 or (models[0].layout is not None and len({m.layout for m in models}) == 1)
        self._models_heading = any(_models_heading(model) for model in models)
        self.state_dim = max(model.state_dim for model in models) + 1
        self.noise_dim = max(model.noise_dim for model in models) + 1

    @property
    def _parts(self) -> list[Dynamics]:
        return cast(list[Dynamics], list(self.models))

    def forward(self, state: Tensor, dt: float | Tensor) -> Switched:
        """Return the law of the next state over `dt`.

        Raises:
            InputError: if the chain listens: the law then depends on the frame's speech, see `moves`.
        """
        check_event(state, (self.state_dim,), "state")
        before = state[..., -1]
        table = self.chain(dt)
        shape = torch.broadcast_shapes(before.shape, table.shape[:-2])
        row = before.long().expand(shape)[..., None, None]
        rows = table.expand(*shape, -1, -1).take_along_dim(row, -2)[..., 0, :]
        flat, of = _flat(state[..., :-1]), self._layout(before).flatten()
        laws = []
        for s, model in enumerate(self._parts):
            laid_out = flat if self._alike else self._carried(flat, of, torch.full_like(of, s))
            own = laid_out[: model.state_dim]
            laws.append(model(own.view(-1, *before.shape).movedim(0, -1), dt))
        return Switched(rows, laws)

    def transition(self, dt: float | Tensor) -> Transition:
        """Return the step by the chain itself, without exploring and without its gradient; see `moves`."""
        move = self._move(self.chain(_of_clouds(dt)).detach(), dt, explore=0.0)
        return lambda state, noise: move(state, noise)[0]

    def moves(self, observations: Any, dt: float | Tensor) -> Iterable[Move]:
        """Return the step into each frame; a chain that listens reads `observations.speech` (T, *batch).

        Raises:
            InputError: for observations without speech, if the chain listens.
        """
        if not self.chain.listens:
            return itertools.repeat(self._move(self.chain(_of_clouds(dt)), dt, explore=self.explore))
        speech = getattr(observations, "speech", None)
        if speech is None:
            raise InputError("observations must have `speech` for a chain that listens to it")
        tables = self.chain(_of_clouds(dt), speech)
        transitions = [model.transition(dt) for model in self._parts]
        return (self._move(table, dt, transitions, explore=self.explore) for table in tables.unbind(0))

    def mode(self, state: Tensor) -> Tensor:
        """Return ones and zeros (..., S): which model moved each particle last."""
        mode = state[..., -1]
        return torch.stack([mode == s for s in range(self.num_modes)]).to(state).movedim(0, -1)

    def kinematics(self, state: Tensor) -> Kinematics:
        check_event(state, (self.state_dim,), "state")
        if self._alike:
            return self._parts[0].kinematics(state.narrow(-1, 0, self.state_dim - 1))
        flat, of = _flat(state[..., :-1]), self._layout(state[..., -1]).flatten()
        known = [model.kinematics(own.mT) for model, own in zip(self._parts, self._own(flat, of), strict=True)]
        parts = [[k.position.mT, k.velocity.mT, *([k.heading[None]] if self._models_heading else [])] for k in known]
        found = [
            _selected(of, said, len(said[0])).view(-1, *state.shape[:-1]).movedim(0, -1)
            for said in zip(*parts, strict=True)
        ]
        return Kinematics(found[0], found[1], found[2][..., 0] if self._models_heading else None)

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
        draw = drawn_from(table, explore)

        def move(state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor | None]:
            check_event(state, (self.state_dim,), "state")
            check_event(noise, (self.noise_dim,), "noise")
            shape = state.shape[:-1]
            if shape != noise.shape[:-1]:  # asked before: broadcast_shapes imports for half a second
                shape = torch.broadcast_shapes(shape, noise.shape[:-1])
                state, noise = state.expand(*shape, -1), noise.expand(*shape, -1)
            before = state[..., -1]
            after, log_weight = draw(before, noise[..., -1])
            flat, numbers = _flat(state[..., :-1]), _flat(noise[..., :-1])
            clouds = shape if isinstance(dt, Tensor) and dt.ndim > 0 else flat.shape[1:]
            moved = self._moved(flat, numbers, before.flatten(), after.flatten(), steps, clouds)
            return moved.view(-1, *shape).movedim(0, -1), log_weight

        return move

    def _moved(
        self,
        flat: Tensor,
        noise: Tensor,
        before: Tensor,
        after: Tensor,
        steps: Sequence[Transition],
        clouds: torch.Size,
    ) -> Tensor:
        """Return the next states (D, n) of `flat` (D - 1, n) by `noise` (K, n), modes (n,) before and after.

        The models see n particles as `clouds` (*batch, N) where time steps differ from cloud to cloud, else as one.
        """
        laid_out = flat if self._alike else self._carried(flat, self._layout(before), after)
        states = self._own(laid_out, after)
        moved = [
            _flat(step(_as(clouds, own), _as(clouds, noise[: model.noise_dim])))
            for model, step, own in zip(self._parts, steps, states, strict=True)
        ]
        out = _selected(after, moved, self.state_dim)
        out[-1] = after
        return out

    def _own(self, flat: Tensor, of: Tensor) -> list[Tensor]:
        """Return what every model works on, (D_s, n): all particles, of which those of its mode (n,) will be selected.

        That takes less time than to pick them. A model that does not say its layout sees a valid state where
        another's numbers are, which may be beyond its domain: what the first particle would be in its layout.
        """
        parts = [flat[: model.state_dim] for model in self._parts]
        wary = [s for s, model in enumerate(self._parts) if model.layout is None]
        if not wary or self.num_modes == 1 or flat.shape[1] == 0:
            return parts
        giver = self._parts[int(of[0])]
        first = giver.kinematics(flat[: giver.state_dim, :1].detach().mT)
        for s in wary:
            valid = self._parts[s].from_kinematics(first).mT.to(flat)
            parts[s] = torch.where((of == s).expand(parts[s].shape), parts[s], valid)
        return parts

    def _carried(self, flat: Tensor, of: Tensor, to: Tensor) -> Tensor:
        """Return states (D - 1, n) that are laid out as model `of` (n,) has it, laid out as model `to` has it."""
        changed = (of - to).nonzero()[:, 0]
        if len(changed) == 0:
            return flat
        some, new = flat.index_select(1, changed), to.index_select(0, changed)
        given = self.kinematics(torch.cat([some, of.index_select(0, changed)[None]]).mT)
        taken = [model.from_kinematics(given).mT for model in self._parts]
        return flat.index_copy(1, changed, _selected(new, taken, len(flat)))

    def _layout(self, mode: Tensor) -> Tensor:
        """Return whose layout a state has: that of its mode's model, and of the first before the first frame."""
        return mode * (self.num_modes - mode).clamp_max(1)


def _models_heading(model: Dynamics) -> bool:
    """Return whether the kinematics of `model` have a heading of their own, asked of a talker who walks."""
    with torch.no_grad():
        walking = model.from_kinematics(Kinematics(torch.ones(1, model.axes), torch.ones(1, model.axes)))
        return model.kinematics(walking).modelled_heading is not None


def _selected(mode: Tensor, said: Sequence[Tensor], rows: int) -> Tensor:
    """Return for each of n particles what its `mode` (n,) says, of what every mode says (J_s, n): (rows, n).

    Below a shorter answer stand zeros.
    """
    masks = [_is(mode, s, len(said)) for s in range(1, len(said))]
    selected, longest = _with_zeros(said[0], rows), max(map(len, said))
    for value, here in zip(said[1:], masks, strict=True):
        # exact at 0 and 1, and ten times as fast as a choice by a mask that changes from particle to particle;
        # in place, since fresh memory for 1e5 particles costs more than the work on it
        selected[: len(value)].lerp_(value, here)
        if len(value) < longest:
            selected[len(value) : longest].mul_(1 - here)
    if math.isfinite(selected.detach().sum()):
        return selected
    # 0 times NaN is NaN: what a model says of another's particles must not reach them
    selected = _with_zeros(said[0], rows)
    for value, here in zip(said[1:], masks, strict=True):
        selected = torch.where(here > 0, _with_zeros(value, rows), selected)
    return selected


def _is(mode: Tensor, s: int, modes: int) -> Tensor:
    """Return 1 for particles (n,) of mode `s` > 0, else 0, in floats: a comparison takes longer."""
    if s == modes - 1:
        return mode if s == 1 else (mode - (s - 1)).clamp_min(0)
    return (1 - (mode - s).abs()).clamp_min(0)


def _with_zeros(said: Tensor, rows: int) -> Tensor:
    """Return a copy of `said` (J, n) with zeros below, (rows, n)."""
    return torch.cat([said, said.new_zeros(rows - len(said), said.shape[1])])


def _of_clouds(dt: float | Tensor) -> float | Tensor:
    """Return a time step that is one for all particles of a cloud (*batch, 1) as that of the cloud (*batch)."""
    if not isinstance(dt, Tensor) or dt.ndim == 0:
        return dt
    if dt.shape[-1] != 1:
        raise ShapeError(f"dt must be one number, or one for each cloud (*batch, 1), got shape {tuple(dt.shape)}")
    return dt[..., 0]


def _as(clouds: torch.Size, flat: Tensor) -> Tensor:
    """Return vectors `flat` (D, n) as (*batch, N, D), without a copy."""
    return flat.view(-1, *clouds).movedim(0, -1)


def _flat(vectors: Tensor) -> Tensor:
    """Return vectors (..., D) variables first, (D, n)."""
    variables = vectors.movedim(-1, 0)
    return variables.reshape(len(variables), -1)
