"""Which way of moving follows which: a Markov chain with learnable probabilities."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive
from probtrack.dynamics.processes import seconds
from probtrack.errors import InputError, ShapeError

Table = Tensor | Sequence[Sequence[float]]

_ROUNDING = 1e-6


class MarkovChain(nn.Module):
    r"""Markov chain over S modes, s_t ~ P(s_t | s_{t-1}), whose transitions may listen to speech:

    .. math:: P_t = \alpha_t P^{\text{speech}} + (1 - \alpha_t) P^{\text{silence}} ,

    with alpha the probability of speech in frame t. Without a matrix for silence the chain does not listen.

    The probabilities are those of a step of `dt`. Over n + r such steps, 0 <= r < 1, the chain moves by
    P^n (I + r (P - I)): by powers where steps are whole, and in between so that modes are left as often per
    second as at `dt`. That is a stochastic matrix for every P and every time step.

    Args:
        initial: Initial probabilities of the mode in the first frame (S,); learnable as `logit_initial`.
        transition: Initial P (S, S), row i the law of what follows mode i; learnable as `logit_transition`.
        silence: The same while nobody speaks, if the chain listens (`transition` is then that of speech);
            learnable as `logit_silence`.
        dt: Time step that the matrices are for [s].

    A probability of 0 stays 0 in learning.

    Raises:
        ShapeError: for a matrix of another shape.
        InputError: for probabilities that are negative or do not sum to 1.

    References:
        S1 section 3.3 and Figure 2; eq. 32 is the chain whose rows are all (P_1, 1 - P_1).

    >>> chain = MarkovChain([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], dt=0.032)
    >>> [[round(p, 3) for p in row] for row in chain(0.064).exp().tolist()]  # two steps; the last row is the start
    [[0.83, 0.17], [0.34, 0.66], [0.5, 0.5]]
    """

    def __init__(
        self, initial: Tensor | Sequence[float], transition: Table, *, silence: Table | None = None, dt: float = 0.032
    ) -> None:
        super().__init__()
        first = _probabilities(initial, "initial")
        if first.ndim != 1 or len(first) < 1:
            raise ShapeError(f"initial must have shape (S,), got {tuple(first.shape)}")
        self.num_modes = len(first)
        self.dt = _one_time_step(dt)
        self.logit_initial = nn.Parameter(first.log())
        self.logit_transition = nn.Parameter(self._matrix(transition, "transition").log())
        self.logit_silence = None if silence is None else nn.Parameter(self._matrix(silence, "silence").log())

    @classmethod
    def dwelling(cls, times: Sequence[float], *, dt: float = 0.032) -> "MarkovChain":
        """Return the chain that stays in mode i for `times[i]` [s] on average and then takes any other alike.

        The first mode is drawn as the chain finds itself in the long run.

        Raises:
            ShapeError: unless there are times of at least 2 modes.
            InputError: for a time that is shorter than `dt`: no mode can be left within a frame.
        """
        step, mean = _one_time_step(dt), as_positive(torch.as_tensor(times), "times")
        if mean.ndim != 1 or len(mean) < 2:
            raise ShapeError(f"times must have shape (S,) with S at least 2, got {tuple(mean.shape)}")
        if not (mean >= step).all():
            raise InputError(f"times must be at least dt = {step:g} s, got {_rounded(mean.tolist())}")
        leave = step / mean  # of a geometric number of frames, whose mean is times / dt
        elsewhere = (leave / (len(mean) - 1))[:, None].expand(len(mean), len(mean))
        transition = torch.where(torch.eye(len(mean), dtype=torch.bool), torch.diag(1 - leave), elsewhere)
        return cls(mean / mean.sum(), transition, dt=dt)

    @property
    def listens(self) -> bool:
        """Whether transitions depend on speech activity."""
        return self.logit_silence is not None

    def forward(self, dt: float | Tensor, speech: Tensor | None = None) -> Tensor:
        """Return log P(mode | mode before) over `dt` [s], (..., S + 1, S).

        Row i < S is of mode i before; the last row is of the start, when there was none.

        Args:
            dt: Time step (...) [s].
            speech: Probability of speech in each frame (...), broadcast with `dt`; only if the chain listens.

        Raises:
            InputError: for a time step that is not positive, or no speech for a chain that listens.
        """
        steps = seconds(dt, self.logit_transition.double()) / self.dt
        matrix = _over(self.logit_transition.softmax(-1), steps)
        if self.logit_silence is not None:
            if speech is None:
                raise InputError("speech must be given to a chain that listens to it, got None")
            if not ((speech >= 0) & (speech <= 1)).all():
                low, high = speech.min().item(), speech.max().item()
                raise InputError(f"speech must be a probability in [0, 1], got values from {low:g} to {high:g}")
            share = speech.to(matrix)[..., None, None]
            matrix = share * matrix + (1 - share) * _over(self.logit_silence.softmax(-1), steps)
        start = self.logit_initial.softmax(-1).expand(*matrix.shape[:-2], 1, -1)
        return _log(torch.cat([matrix, start], -2))

    def _matrix(self, table: Table, name: str) -> Tensor:
        matrix = _probabilities(table, name)
        if matrix.shape != (self.num_modes, self.num_modes):
            raise ShapeError(f"{name} must have shape ({self.num_modes}, {self.num_modes}), got {tuple(matrix.shape)}")
        return matrix

    def extra_repr(self) -> str:
        names = {"initial": self.logit_initial, "transition": self.logit_transition, "silence": self.logit_silence}
        shown = [f"{name}={_rounded(logit.softmax(-1).tolist())}" for name, logit in names.items() if logit is not None]
        return ", ".join([*shown, f"dt={self.dt:g} s"])


def _one_time_step(dt: float | Tensor) -> float:
    """Return `dt` as a number, not rounded, or raise `InputError` unless it is one, finite and > 0."""
    if isinstance(dt, Tensor) and dt.ndim > 0:
        raise InputError(f"dt must be one number for the matrices of a chain, got shape {tuple(dt.shape)}")
    as_positive(dt, "dt")
    return float(dt)


def _over(matrix: Tensor, steps: Tensor) -> Tensor:
    """Return P^n (I + r (P - I)) of P = `matrix` (S, S), n + r = `steps` (...) in float64: (..., S, S)."""
    # a quotient of floats, of time steps that may have been float32, misses a whole number
    nearest = steps.round()
    is_whole = (steps - nearest).abs() <= _ROUNDING * torch.maximum(steps, nearest)
    whole = torch.where(is_whole, nearest, steps.floor())
    part = torch.where(is_whole, 0.0, steps - whole)[..., None, None]
    moved = _power(matrix.double(), whole)  # in float32 rows of high powers lose their sum
    moved = moved / moved.sum(-1, keepdim=True)
    return (moved @ torch.lerp(torch.eye(len(matrix)).to(moved), matrix.double(), part)).to(matrix)


def _power(matrix: Tensor, exponent: Tensor) -> Tensor:
    """Return powers (..., S, S) of `matrix` (S, S) with whole numbers `exponent` (...), by repeated squaring."""
    left = exponent.long()
    power = torch.eye(len(matrix)).to(matrix).expand(*exponent.shape, -1, -1)
    while True:
        power = torch.where((left % 2 == 1)[..., None, None], power @ matrix, power)
        left = left // 2
        if not left.any():
            return power
        matrix = matrix @ matrix


def _log(p: Tensor) -> Tensor:
    """Return log p, -inf at 0, with a gradient that is 0 there: that of log is infinite."""
    possible = p > 0
    return torch.where(possible, torch.where(possible, p, 1.0).log(), -torch.inf)


def _probabilities(table: Tensor | Sequence[object], name: str) -> Tensor:
    """Return `table` (..., S) as floats, or raise `InputError` unless rows are probabilities that sum to 1."""
    try:
        p = torch.as_tensor(table, dtype=torch.get_default_dtype())
    except (ValueError, TypeError):
        raise ShapeError(f"{name} must be a table of numbers with rows of one length, got {table}") from None
    if not (torch.isfinite(p) & (p >= 0)).all():
        raise InputError(f"{name} must be finite and not negative, got {p.tolist()}")
    if p.ndim == 0:
        raise ShapeError(f"{name} must be a table of numbers, got {p.item()}")
    total = p.sum(-1)
    if not torch.allclose(total, torch.ones_like(total), rtol=0, atol=1e-5):
        raise InputError(f"{name} must have rows that sum to 1, got sums {_rounded(total.tolist())}")
    return p / total[..., None]


def _rounded(values: object) -> object:
    return [_rounded(v) for v in values] if isinstance(values, list) else float(f"{values:.3g}")
