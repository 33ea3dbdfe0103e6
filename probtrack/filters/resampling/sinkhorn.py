"""Entropy-regularised transport from equal weights to given ones over the same points, and its derivatives."""

import torch
from torch import Tensor

from probtrack.filters.resampling.spread import half_squared_distances

_ANNEAL = 4.0  # epsilon falls by that from stage to stage
_ROUND = 8  # iterations between looks at the error
_LARGE = 1e10  # scaling beyond which the kernel is made anew, well before float32 overflows


def potentials(
    points: Tensor, weight: Tensor, epsilon: float, tolerance: float, iterations: int
) -> tuple[Tensor, Tensor]:
    r"""Return the potentials f and g (B, N) whose plan has rows 1/N and, within `tolerance`, columns `weight`.

    .. math:: P_{ij} = \frac{w_j}{N} \exp\frac{f_i + g_j - C_{ij}}{\varepsilon}, \qquad
              C_{ij} = \tfrac12 \lVert x_i - x_j \rVert^2 .

    Sinkhorn's iterations scale the rows and columns of a kernel that has the potentials found so far in it: products of
    matrices with vectors, instead of a logarithm and an exponential an entry. The kernel is made anew, by sums of
    exponentials in log space, when scalings grow large and whenever epsilon falls, which it does in stages from the
    largest cost.

    Args:
        points: (B, N, D).
        weight: (B, N), sum 1; zeros allowed.
        epsilon: Weight of the entropy, in units of the cost.
        tolerance: Share of the mass that may be in the wrong row when iterations end.
        iterations: Most of them at the final epsilon.

    References:
        B. Schmitzer, "Stabilized sparse scaling algorithms for entropy regularized transport problems", SIAM J. Sci.
        Comput. 41(3), 2019: absorption of the scalings, and scaling of epsilon.
    """
    cost, log_weight = half_squared_distances(points, points), weight.log()
    kernel = torch.empty_like(cost)  # the one large buffer: fresh memory costs more than the work on it
    g, left = torch.zeros_like(weight), iterations
    stage = (cost.amax((1, 2)) / _ANNEAL**2).clamp_min(epsilon)[:, None]
    while True:
        torch.sub((g + stage * log_weight)[:, None], cost, out=kernel).div_(stage[..., None])
        top = kernel.amax(2)
        f = -stage * (top + kernel.sub_(top[..., None]).exp_().sum(2).log())
        torch.sub(f[:, :, None], cost, out=kernel).div_(stage[..., None])
        top = kernel.amax(1)
        kernel.sub_(top[:, None]).exp_()
        last = bool((stage == epsilon).all())
        u, v, error, done = _scaled(kernel, weight, tolerance, left if last else _ROUND)
        f, g = f + stage * u.log(), stage * (v.log() - top)
        left -= done * last
        if last and (error < tolerance or left <= 0):
            return f, g
        stage = (stage / _ANNEAL).clamp_min(epsilon)


def transport_plan(points: Tensor, weight: Tensor, f: Tensor, g: Tensor, epsilon: float) -> Tensor:
    """Return the plan P (B, N, N) of `potentials`."""
    exponent = (f[:, :, None] + g[:, None] - half_squared_distances(points, points)).div_(epsilon)
    return exponent.exp_().mul_(weight[:, None] / weight.shape[1])


def plan_gradients(plan: Tensor, points: Tensor, grad: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    r"""Return what of the gradient `grad` (B, N, D) of N P x passes through P: to the points and the log weights.

    With :math:`\Gamma_{ij} = N\, G_i \cdot x_j` the gradient in P, and multipliers of its two conditions that solve

    .. math:: \begin{pmatrix} 1/N & P \\ P^\top & w \end{pmatrix} \begin{pmatrix} \lambda \\ \mu \end{pmatrix}
              = \begin{pmatrix} (P \circ \Gamma) 1 \\ (P \circ \Gamma)^\top 1 \end{pmatrix},

    the gradient is :math:`P_{ij} (\lambda_i + \mu_j - \Gamma_{ij}) / \varepsilon` in the cost and :math:`w_j \mu_j` in
    the log weights. The system is solved for :math:`\sqrt{w} \mu` by Cholesky factors; a constant that may be added to
    one multiplier and taken from the other is fixed by :math:`w \cdot \mu = 0`.
    """
    size, eps = plan.shape[1], torch.finfo(plan.dtype).eps
    weight = plan.sum(1)  # as met, so that rows and columns belong together
    root = weight.sqrt()
    inverse = torch.where(root > 0, 1 / root, 0.0)
    half = plan * (size**0.5 * inverse)[:, None]
    through = plan * (grad @ points.mT) * size
    rows, columns = through.sum(2), through.sum(1)
    system = torch.baddbmm(root[:, :, None] * root[:, None], half.mT, half, alpha=-1)
    system.diagonal(dim1=1, dim2=2).add_(1 + 10 * size * eps)
    target = columns * inverse - size**0.5 * _times(half.mT, rows)
    factor = torch.linalg.cholesky_ex(system).L
    mu = torch.cholesky_solve(target[..., None], factor)[..., 0] * inverse
    lam = size * (rows - _times(plan, mu))
    of_cost = (plan * (lam[:, :, None] + mu[:, None]) - through) / epsilon
    return -(of_cost + of_cost.mT) @ points, weight * mu


def _scaled(kernel: Tensor, weight: Tensor, tolerance: float, iterations: int) -> tuple[Tensor, Tensor, float, int]:
    """Return u and v (B, N) such that w_j u_i K_ij v_j / N has rows 1/N and nearly columns w, the error and how many
    iterations it took.

    The error is the share of the mass that was in wrong rows when the columns were right, half an iteration before.
    """
    u, error, done = torch.ones_like(weight), float("inf"), 0
    while done < iterations:
        for _ in range(_ROUND):
            v = kernel.shape[1] / _times(kernel.mT, u)
            before, u = u, 1 / _times(kernel, weight * v)
        done += _ROUND
        wrong = (u / before - 1).abs().mean(1).amax()
        error, largest = torch.stack([wrong, torch.maximum(u, v).amax()]).tolist()
        if error < tolerance or largest > _LARGE:
            break
    return u, v, error, done


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return `matrix` (B, N, N) times `vector` (B, N)."""
    # as a row: a batch of products with columns takes four times as long
    return (vector[:, None] @ matrix.mT)[:, 0]
