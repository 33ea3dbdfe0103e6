"""Fitting motion models to trajectories. Imports Lightning, so that it is loaded when it is first named only."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Normal

from probtrack._checks import as_positive
from probtrack.dynamics import Curvilinear, Dynamics, Kinematics
from probtrack.errors import InputError
from probtrack.filters import (
    Adaptive,
    Belief,
    Cloud,
    Gaussian,
    LinearDynamics,
    NoiseStream,
    ParticleFilter,
    Resampler,
    StopGradient,
    kalman_filter,
    position_system,
    resampling,
)
from probtrack.likelihoods import GaussianPosition, Positions
from probtrack.training.fit import Fit
from probtrack.training.losses import Loss, NegativeLogEvidence, Outcome
from probtrack.training.trajectories import TrajectoryBatch
from probtrack.training.trajectories_paths import FixedPaths


class TrajectoryFit(Fit):
    r"""A motion model in training on trajectories, whose positions are measured with Gaussian error:

    .. math:: p(y_{2:T} \mid y_1), \qquad
              \ell_1 \mid y_1 \sim \mathcal N(y_1, \sigma^2 I), \quad \dot\ell_1 \sim \mathcal N(0, v^2 I) .

    The place where a trajectory begins says nothing of how talkers move: its first position is given, and with it the
    law of the state then; what a model remembers beyond position and velocity begins at 0. Of a linear model the
    evidence is the Kalman filter's; of all others it is the particle filter's, an unbiased estimate with an unbiased
    gradient if resampling carries those of weights, as it does by default.

    Args:
        dynamics: The motion model, from the parameters it starts with.
        std: Standard deviation sigma of a measured position that the fit starts with, on each axis [m].
        learn_std: Whether sigma is learned too.
        speed: v, of talkers at the start of a trajectory, r.m.s. on each axis [m/s].
        exact: Whether to use the Kalman filter; None where the model is linear. False for particles in any case.
        num_particles: N of the particle filter.
        resample: What happens to its clouds; systematic resampling by `StopGradient` on N_eff < 0.5 N if not
            given. Plain resampling forgets what weights owe to the parameters, which in a curvilinear model is all.
        loss: What is made small; the negative log evidence, a frame, if not given.
        learning_rate: Step of Adam, in units of unconstrained parameters.
        seed: Of the filter's random numbers.

    Raises:
        InputError: for values that cannot be, or an exact evidence of a model that is not linear.
    """

    model: ParticleFilter

    def __init__(
        self,
        dynamics: Dynamics,
        *,
        std: float = 0.02,
        learn_std: bool = True,
        speed: float = 1.0,
        exact: bool | None = None,
        num_particles: int = 200,
        resample: Resampler | None = None,
        loss: Loss | None = None,
        learning_rate: float = 0.02,
        seed: int = 0,
    ) -> None:
        linear = isinstance(dynamics, LinearDynamics)
        if exact and not linear:
            raise InputError(f"exact must be False for {type(dynamics).__name__}: it has no matrices of a linear step")
        likelihood = GaussianPosition(std)
        likelihood.log_std.requires_grad_(learn_std)
        model = ParticleFilter(
            dynamics,
            likelihood,
            num_particles=num_particles,
            resample=Adaptive(StopGradient(resampling.systematic), 0.5) if resample is None else resample,
        )
        super().__init__(model, NegativeLogEvidence() if loss is None else loss, learning_rate=learning_rate, seed=seed)
        self.exact = linear if exact is None else exact
        self.speed = float(as_positive(speed, "speed"))

    def numbers(self, batch: TrajectoryBatch) -> Sequence[int]:
        return batch.numbers

    def outcome(self, batch: TrajectoryBatch, seeds: Tensor) -> Outcome:
        dynamics = self.model.dynamics
        if batch.first.shape[-1] != dynamics.axes:
            raise InputError(
                f"trajectories must have {dynamics.axes} axes, those of the model, got {batch.first.shape[-1]}"
            )
        cloud = self._kalman(batch) if self.exact else self._particles(batch, seeds)
        return Outcome(cloud, dynamics.kinematics(cloud.state), inside=batch.inside)

    def _kalman(self, batch: TrajectoryBatch) -> Cloud:
        """Return what the Kalman filter finds, as a cloud of one particle at its mean."""
        dynamics, std = self.model.dynamics, self._std
        assert isinstance(dynamics, LinearDynamics)
        system = position_system(dynamics, batch.time_step(), std)
        observed = None if batch.observed.all() else batch.observed
        result = kalman_filter(batch.position.to(std), system, self._first(batch, std), observed=observed)
        mean, evidence = result.filtered.mean, result.increments
        weight = torch.zeros_like(evidence)
        return Cloud(mean[..., None, :], weight[..., None], evidence, torch.zeros_like(weight, dtype=torch.bool))

    def _first(self, batch: TrajectoryBatch, std: Tensor) -> Gaussian:
        """Return the law of the state when the first position was measured."""
        dynamics = self.model.dynamics
        first = batch.first.to(std)
        mean = dynamics.from_kinematics(Kinematics(first, torch.zeros_like(first)))
        eye = torch.eye(dynamics.axes).to(std)
        zero = torch.zeros_like(eye)
        from_position = dynamics.from_kinematics(Kinematics(eye, zero)) * std  # linear: rows are its columns
        from_velocity = dynamics.from_kinematics(Kinematics(zero, eye)) * self.speed
        root = torch.cat([from_position, from_velocity])
        return Gaussian(mean, root.mT @ root)

    def _particles(self, batch: TrajectoryBatch, seeds: Tensor) -> Cloud:
        model, dynamics = self.model, self.model.dynamics
        if isinstance(dynamics, Curvilinear) and dynamics.axes == 2:
            model = ParticleFilter(
                FixedPaths(dynamics), model.likelihood, num_particles=model.num_particles, resample=model.resample
            )
        noise, y = model.noise(seeds), batch.position.to(self._std)
        observations = y if batch.observed.all() else Positions(y, batch.observed)
        return model.run(self._cloud(batch, noise), observations, batch.time_step(), noise)[1]

    def _cloud(self, batch: TrajectoryBatch, noise: NoiseStream) -> Belief:
        """Return particles of the law when the first position was measured; weights carry the gradient of sigma.

        Of the velocities that a talker may have few lead to the next position. They are drawn half from their law and
        half around the way to that position, and weighted by p / q, which is below 2.
        """
        std, count, axes = self._std, self.model.num_particles, batch.first.shape[-1]
        now = std.detach()
        ahead, elapsed = _next(batch)
        towards = ((ahead - batch.first) / elapsed[:, None]).to(std)[:, None]
        near = (self.speed**2 / 100 + 2 * (now / elapsed.to(std)).square()).sqrt()[:, None, None]
        error = now * noise.normal(count, axes)
        drawn, half = noise.normal(count, axes), noise.uniform(count, 1) < 0.5
        velocity = torch.where(half, towards + near * drawn, self.speed * drawn)
        law = _log_normal(velocity, self.speed)
        mixture = torch.logaddexp(law, _log_normal(velocity - towards, near)) - math.log(2)
        position = batch.first.to(std)[:, None] + error
        state = self.model.dynamics.from_kinematics(Kinematics(position, velocity))
        log_weight = law - mixture + _log_normal(error, std) - _log_normal(error, now) - math.log(count)
        return Belief(state, log_weight, log_weight.new_zeros(log_weight.shape[:-1]))

    @property
    def _std(self) -> Tensor:
        """Standard deviation of a measured position () [m]."""
        likelihood = self.model.likelihood
        assert isinstance(likelihood, GaussianPosition)
        return likelihood.log_std.exp()


def _next(batch: TrajectoryBatch) -> tuple[Tensor, Tensor]:
    """Return the second measured position of each trajectory (B, A), and the time to it (B,)."""
    frame = batch.observed.int().argmax(0)  # the first one
    elapsed = batch.dt.cumsum(0).gather(0, frame[None])[0]
    return batch.position[frame, torch.arange(len(frame), device=frame.device)], elapsed


def _log_normal(x: Tensor, std: float | Tensor) -> Tensor:
    """Return log densities (...) of independent normal `x` (..., A)."""
    density: Tensor = Normal(torch.zeros_like(x), std).log_prob(x)
    return density.sum(-1)
