"""Trackers trained on recordings. Imports Lightning, so that it is loaded when it is first named only."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from probtrack._checks import as_positive, check_int
from probtrack.errors import InputError
from probtrack.metrics import position_error
from probtrack.trackers import Tracker
from probtrack.training.batches import SceneBatch
from probtrack.training.fit import Fit
from probtrack.training.hearing import heard, keep_fixed, numbers_of, true_position
from probtrack.training.losses import Loss, Outcome, ProposalLoss
from probtrack.training.settings import TrackerSettings
from probtrack.training.windows import run_in_windows

_LOST = 0.2  # m beyond which a frame of the validation counts as lost


class SceneFit(Fit):
    """A tracker in training on scenes: motion, likelihood, switching, proposal, and the front end if it is given sound.

    A batch of sound is heard by the tracker's own front end, whose parameters (voice activity, frequency weights) then
    learn with the rest; a batch of observations is what a front end heard that does not. The cloud begins around the
    talker, as S1's do.

    Args:
        tracker: What is trained.
        loss: What is made small; that of the proposal is added where the tracker has one.
        warm_up: Frames at the beginning of each recording or crop that are heard but not tracked, so that voice
            activity knows the noise floor.
        start_std: Standard deviation of the cloud around the talker [m].
        anywhere: Share of runs whose cloud begins all over the region, so that finding a talker is learned too.
        window: Frames that a gradient reaches back; all if None.
        fixed: Parameters that are not trained, as beginnings of their names.
        learning_rate: As in `Fit`.
        seed: As in `Fit`.
    """

    def __init__(
        self,
        tracker: TrackerSettings,
        loss: Loss,
        *,
        warm_up: int = 0,
        start_std: float = 0.1,
        anywhere: float = 0.0,
        window: int | None = 25,
        fixed: Sequence[str] = ("front_end.gcc.whitening",),
        learning_rate: float = 0.02,
        seed: int = 0,
    ) -> None:
        super().__init__(tracker.make(), loss, learning_rate=learning_rate, seed=seed)
        self.warm_up = check_int(warm_up, "warm_up", low=0)
        as_positive(start_std, "start_std")
        if not 0 <= anywhere <= 1:
            raise InputError(f"anywhere must be in [0, 1], got {anywhere}")
        self.start_std, self.anywhere = start_std, anywhere
        self.window = None if window is None else check_int(window, "window", low=1)
        self.proposal_loss = ProposalLoss()
        keep_fixed(self.model, fixed)

    @property
    def tracker(self) -> Tracker:
        """What is trained."""
        return cast(Tracker, self.model)

    def numbers(self, batch: SceneBatch) -> Sequence[int]:
        return numbers_of(batch)

    def loss_of(self, outcome: Outcome) -> Tensor:
        return self.loss(outcome) + self.proposal_loss(outcome)

    def outcome(self, batch: SceneBatch, seeds: Tensor) -> Outcome:
        tracked, observations = self.tracker.filter, heard(self.tracker, batch, self.warm_up)
        position, known = true_position(self.tracker, batch, self.warm_up)
        noise = tracked.noise(seeds)
        belief = tracked.spread_around(position[0], noise, std=self.start_std)
        if self.anywhere > 0:
            anywhere = noise.uniform(1, 1) < self.anywhere
            spread = tracked.spread_over(self.tracker.region, noise)
            belief = belief._replace(state=torch.where(anywhere, spread.state, belief.state))
        cloud = run_in_windows(tracked, belief, observations, self.tracker.dt, noise, self.window)
        return Outcome(cloud, tracked.dynamics.kinematics(cloud.state), position, known)

    def log_outcome(self, outcome: Outcome) -> None:
        """Log the root mean square error [m] and the share of frames that are lost, where the truth is known."""
        assert outcome.truth is not None
        assert outcome.known is not None
        error, runs = position_error(outcome.estimate, outcome.truth), outcome.known.any(0)
        if not runs.any():
            return
        error, known = error[:, runs], outcome.known[:, runs]
        square = torch.where(known, error.square(), 0.0).sum(0) / known.sum(0)
        lost = ((error > _LOST) & known).sum(0) / known.sum(0)
        for name, value in {"val/rmse": square.sqrt(), "val/lost": lost}.items():
            self.log(name, value.mean(), prog_bar=True, batch_size=len(value), sync_dist=True)
