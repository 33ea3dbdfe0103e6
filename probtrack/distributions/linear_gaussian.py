"""Gaussian law given by how noise enters, so that it may be confined to fewer directions than its space."""

import math
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.types import _size

from probtrack._checks import check_event
from probtrack.errors import ShapeError, SingularLawError


class LinearGaussian(Distribution):
    r"""Law of a linear map of standard normal noise:

    .. math:: x = \mathrm{loc} + \mathrm{gain}\, u, \qquad u \sim \mathcal{N}(0, I_K) .

    Its covariance gain gain^T may be singular, as that of motion models in which one noise drives position
    and velocity: the law can then be sampled but has no density, and `log_prob` raises `SingularLawError`.

    Args:
        loc: Mean (..., D).
        gain: How each of K standard normal numbers enters (..., D, K), any rank; its batch broadcasts
            with that of `loc`.
        validate_args: As in `torch.distributions`.

    Shape:
        Batch (...), event (D,).

    >>> law = LinearGaussian(torch.zeros(2), torch.tensor([[0.5], [1.0]]))
    >>> law.covariance_matrix.tolist()
    [[0.25, 0.5], [0.5, 1.0]]
    >>> law.at_noise(torch.tensor([2.0])).tolist()
    [1.0, 2.0]
    """

    arg_constraints = {  # noqa: RUF012 (torch declares it as a plain attribute)
        "loc": constraints.real_vector,
        "gain": constraints.independent(constraints.real, 2),
    }
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, loc: Tensor, gain: Tensor, validate_args: bool | None = None) -> None:
        if loc.ndim < 1:
            raise ShapeError("loc must have shape (..., D), got ()")
        if gain.ndim < 2:
            raise ShapeError(f"gain must have shape (..., {loc.shape[-1]}, K), got {tuple(gain.shape)}")
        check_event(gain, (loc.shape[-1], gain.shape[-1]), "gain")
        batch = torch.broadcast_shapes(loc.shape[:-1], gain.shape[:-2])
        self.loc = loc.expand(*batch, -1)
        self.gain = gain.expand(*batch, -1, -1)
        self._gain = gain  # not broadcast: factorised once however many locations share it
        super().__init__(batch, loc.shape[-1:], validate_args=validate_args)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "LinearGaussian":
        new = cast(LinearGaussian, self._get_checked_instance(LinearGaussian, _instance))
        batch = torch.Size(batch_shape)
        new.loc = self.loc.expand(*batch, -1)
        new.gain = self.gain.expand(*batch, -1, -1)
        new._gain = self._gain
        Distribution.__init__(new, batch, self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def noise_dim(self) -> int:
        """How many standard normal numbers K make one value."""
        return self.gain.shape[-1]

    @property
    def mean(self) -> Tensor:
        return self.loc

    @property
    def mode(self) -> Tensor:
        return self.loc

    @property
    def variance(self) -> Tensor:
        return self.gain.square().sum(-1)

    @property
    def covariance_matrix(self) -> Tensor:
        """Covariance gain gain^T (..., D, D), singular if the gain has not full row rank."""
        return self.gain @ self.gain.mT

    def at_noise(self, noise: Tensor) -> Tensor:
        """Return the value (..., D) that the standard normal `noise` (..., K) stands for."""
        return self.loc + _rows_times(noise, self._gain.mT)

    def rsample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        shape = (*sample_shape, *self.batch_shape, self.noise_dim)
        return self.at_noise(torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of `value` (..., D).

        Raises:
            SingularLawError: if the gain has not full row rank, so that there is no density.
        """
        if self._validate_args:
            self._validate_sample(value)
        scale, factor = self._scaled_factor()
        inverse = torch.linalg.solve_triangular(factor, torch.eye(*factor.shape[-2:]).to(factor), upper=True)
        whitened = _rows_times((value - self.loc) / scale, inverse)
        log_volume = (scale.log() + factor.diagonal(dim1=-2, dim2=-1).abs().log()).sum(-1)
        return -0.5 * (whitened.square().sum(-1) + scale.shape[-1] * math.log(2 * math.pi)) - log_volume

    def _scaled_factor(self) -> tuple[Tensor, Tensor]:
        """Return s (..., D) and upper triangular R with gain gain^T = diag(s) R^T R diag(s).

        Rows have unit norm once divided by s, so that units do not make a law look singular. The result
        does not depend on s, which therefore needs no gradient.
        """
        gain = self._gain
        rows, columns = gain.shape[-2:]
        if columns < rows:
            raise SingularLawError(_no_density(f"{columns} noise numbers drive {rows} variables"))
        scale = torch.linalg.vector_norm(gain.detach(), dim=-1)
        if not (scale > 0).all():
            raise SingularLawError(_no_density("no noise reaches some variable"))
        factor = torch.linalg.qr((gain / scale[..., None]).mT).R
        smallest = factor.detach().diagonal(dim1=-2, dim2=-1).abs().min()
        if not smallest > 10 * columns * torch.finfo(gain.dtype).eps:
            raise SingularLawError(_no_density("the rows of the gain depend on each other"))
        return scale, factor


def _rows_times(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return `rows` (..., I) times `matrix` (..., I, J), batches broadcast: (..., J)."""
    if matrix.ndim == 2:
        return rows @ matrix
    return (rows[..., None, :] @ matrix)[..., 0, :]


def _no_density(why: str) -> str:
    return (
        f"this LinearGaussian has no density: {why}, so that its covariance is singular. Sample it, use its "
        "mean and covariance_matrix, or take a law whose gain has full row rank"
    )
