"""Resampling: exact counts, laws of every scheme, and when the adaptive one acts."""

import pytest
import torch
from oracles import resampling as oracle

from probtrack.errors import InputError
from probtrack.filters.resampling import (
    Adaptive,
    effective_sample_size,
    multinomial,
    residual,
    stratified,
    systematic,
)

SCHEMES = {"systematic": systematic, "stratified": stratified, "multinomial": multinomial, "residual": residual}
each_scheme = pytest.mark.parametrize("name", SCHEMES)
each_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def random_weights(*shape, dtype=torch.float64):
    """Weights with zeros at the beginning, in the middle and at the end."""
    weight = torch.randn(shape, dtype=dtype).mul(2).exp()
    weight[..., [0, 1, shape[-1] // 2, -1]] = 0
    return weight / weight.sum(-1, keepdim=True)


def hard_weights(size, dtype):
    """Weights of a million particles: half the mass in one, a tail below rounding, zeros at both ends."""
    weight = torch.rand(size, dtype=dtype) ** 8
    weight[: size // 3] *= 1e-9
    weight[::7] = 0
    weight[:5] = weight[-5:] = 0
    weight[size // 2] = weight.sum()
    return weight / weight.sum()


def uniforms_for(scheme, *batch, size, dtype=torch.float64):
    return torch.rand(*batch, scheme.num_uniforms(size, 4), dtype=dtype)


@each_scheme
@each_dtype
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_counts_sum_to_the_particles_and_none_has_weight_zero(name, dtype, batch):
    scheme, weight = SCHEMES[name], random_weights(*batch, 53, dtype=dtype)
    counts = scheme.offspring(weight, uniforms_for(scheme, *batch, size=53, dtype=dtype))
    assert counts.shape == weight.shape
    assert not counts.is_floating_point()
    assert (counts >= 0).all()
    assert (counts.sum(-1) == 53).all()
    assert (counts[weight == 0] == 0).all()


@each_scheme
@each_dtype
@pytest.mark.parametrize("u", [0.0, 2.0**-24, 0.5, 1 - 2.0**-24])
def test_a_million_particles_keep_the_laws(name, dtype, u):
    size, scheme = 10**6, SCHEMES[name]
    weight = hard_weights(size, dtype)
    counts = scheme.offspring(weight, torch.full((scheme.num_uniforms(size, 4),), u, dtype=dtype))
    assert (counts >= 0).all()
    assert counts.sum() == size
    assert (counts[weight == 0] == 0).all()


@each_scheme
@each_dtype
def test_weights_that_sum_to_a_little_more_than_one_still_give_n_copies(name, dtype):
    size, scheme = 2**20, SCHEMES[name]
    weight = torch.zeros(size, dtype=dtype)
    weight[: size // 2] = 2 / size * (1 + 3e-6)  # as exp of a rounded log weight may be off in float32
    counts = scheme.offspring(weight, uniforms_for(scheme, size=size, dtype=dtype))
    assert counts.sum() == size


@each_scheme
def test_counts_are_those_of_exact_arithmetic(name):
    scheme, weights = SCHEMES[name], random_weights(40, 17)
    uniforms = uniforms_for(scheme, 40, size=17)
    made = scheme.offspring(weights, uniforms).tolist()
    one = name == "systematic"
    exact = getattr(oracle, name)
    assert made == [exact(w, u[0] if one else u) for w, u in zip(weights.tolist(), uniforms.tolist(), strict=True)]


@pytest.mark.parametrize("u", [0.0, 0.25, 0.5, 1 - 2.0**-48])
def test_points_of_the_comb_on_a_border_go_to_the_particle_above(u):
    weights = [0.0, 0.125, 0.375, 0.0, 0.25, 0.25, 0.0, 0.0]  # N C falls on whole numbers
    counts = systematic.offspring(torch.tensor(weights), torch.tensor([u]))
    assert counts.tolist() == oracle.systematic(weights, u)


def test_systematic_draws_no_more_than_there_are_particles_however_many():
    size = 9_000_000  # N eps > 1 in float32
    ends = systematic.ends(torch.full((size,), 1 / size, dtype=torch.float32), torch.zeros(1))
    assert ends[0] >= 0
    assert ends[-1] == size


@each_dtype
def test_systematic_counts_stay_within_one_of_their_expectation(dtype):
    weight = random_weights(200, 31, dtype=dtype)
    counts = systematic.offspring(weight, torch.rand(200, 1, dtype=dtype))
    # N C is off by the rounding of 31 in the worst of two neighbours
    assert ((counts - 31 * weight).abs() < 1 + 2 * 31 * torch.finfo(dtype).eps).all()


@each_dtype
def test_residual_keeps_the_whole_part_of_each_expectation(dtype):
    weight = random_weights(200, 31, dtype=dtype)
    counts = residual.offspring(weight, torch.rand(200, 31, dtype=dtype))
    assert (counts >= (31 * weight * (1 - 1e-6)).floor()).all()


@each_dtype
def test_residual_copies_each_of_equal_particles_once(dtype):
    for size in range(1, 200):  # 49 / 49 rounds to less than 1
        weight = torch.full((size,), 1 / size, dtype=dtype)
        assert (residual.offspring(weight, torch.rand(size, dtype=dtype)) == 1).all()


@each_scheme
def test_expected_counts_are_n_times_the_weights(name):
    scheme, weight, runs = SCHEMES[name], random_weights(13), 20_000
    counts = scheme.offspring(weight.expand(runs, 13), uniforms_for(scheme, runs, size=13)).double()
    std_error = counts.std(0) / runs**0.5
    assert ((counts.mean(0) - 13 * weight).abs() <= 5 * std_error + 1e-12).all()


def test_multinomial_counts_have_the_binomial_variance():
    weight, runs = random_weights(13), 20_000
    counts = multinomial.offspring(weight.expand(runs, 13), torch.rand(runs, 13)).double()
    exact = 13 * weight * (1 - weight)
    fourth = (counts - counts.mean(0)).pow(4).mean(0)
    std_error = ((fourth - exact**2).clamp_min(0) / runs).sqrt()
    assert ((counts.var(0) - exact).abs() <= 5 * std_error + 1e-12).all()


@pytest.mark.parametrize("name", ["systematic", "stratified", "residual"])
def test_scheme_has_less_variance_than_independent_draws(name):
    scheme, weight, runs = SCHEMES[name], random_weights(13), 5_000
    counts = scheme.offspring(weight.expand(runs, 13), uniforms_for(scheme, runs, size=13)).double()
    assert counts.var(0).sum() < 0.8 * (13 * weight * (1 - weight)).sum()


@each_scheme
def test_one_particle_with_all_the_weight_has_all_the_offspring(name):
    scheme, weight = SCHEMES[name], torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0])
    assert scheme.offspring(weight, uniforms_for(scheme, size=5)).tolist() == [0, 0, 5, 0, 0]


@each_scheme
def test_new_cloud_holds_each_particle_as_often_as_its_count(name):
    scheme, weight, state = SCHEMES[name], random_weights(3, 2, 11), torch.randn(3, 2, 11, 4)
    uniforms = uniforms_for(scheme, 3, 2, size=11)
    counts = scheme.offspring(weight, uniforms)
    new, log_weight = scheme(state, weight.log(), uniforms)
    for i, j in [(0, 0), (1, 1), (2, 0)]:
        torch.testing.assert_close(new[i, j], state[i, j].repeat_interleave(counts[i, j], 0), rtol=0, atol=0)
    torch.testing.assert_close(log_weight.exp(), torch.full((3, 2, 11), 1 / 11))


@each_scheme
def test_rows_of_a_batch_do_not_mix(name):
    scheme, log_weight, state = SCHEMES[name], random_weights(6, 11).log(), torch.randn(6, 11, 4)
    uniforms = uniforms_for(scheme, 6, size=11)
    together = scheme(state, log_weight, uniforms)[0]
    alone = torch.stack([scheme(*row)[0] for row in zip(state, log_weight, uniforms, strict=True)])
    assert torch.equal(together, alone)


@each_scheme
def test_gradients_follow_the_ancestors(name):
    scheme, log_weight = SCHEMES[name], random_weights(2, 11).log()
    state, uniforms = torch.randn(2, 11, 3, requires_grad=True), uniforms_for(scheme, 2, size=11)
    scheme(state, log_weight, uniforms)[0].sum().backward()
    counts = scheme.offspring(log_weight.exp(), uniforms)
    torch.testing.assert_close(state.grad, counts[..., None].expand(2, 11, 3).double())


def test_effective_sample_size_is_one_over_the_sum_of_squares():
    log_weight = torch.tensor([[0.5, 0.25, 0.25, 0.0], [0.25, 0.25, 0.25, 0.25], [0.0, 0.0, 0.0, 1.0]]).log()
    torch.testing.assert_close(effective_sample_size(log_weight), torch.tensor([8 / 3, 4.0, 1.0]))


@pytest.mark.parametrize(("rich", "resampled"), [(0.5, False), (0.5 + 1e-6, True), (0.5 - 1e-6, True)])
@pytest.mark.parametrize("batch", [(), (1,), (2, 1)])
def test_resamples_only_below_the_threshold(rich, resampled, batch):
    weight = torch.tensor([rich, 0.0, 1 - rich, 0.0]).expand(*batch, 4)  # N_eff = 2 at rich = 1/2: not below N_thr = 2
    state = torch.randn(*batch, 4, 3)
    new, log_weight = Adaptive(systematic, 0.5)(state, weight.log(), torch.full((*batch, 1), 0.3))
    assert torch.equal(new, state) is not resampled
    assert torch.equal(log_weight, weight.log()) is not resampled


@pytest.mark.parametrize("batch", [(5,), (5, 1), (1, 5)])
@each_scheme
def test_each_cloud_of_a_batch_is_resampled_on_its_own(name, batch):
    scheme = SCHEMES[name]
    weight = random_weights(5, 11)
    weight[[1, 4]] = 0.9 / 11 + 0.1 * weight[[1, 4]]  # nearly equal: left as they are
    state, uniforms = torch.randn(5, 11, 3), uniforms_for(scheme, 5, size=11)
    shaped = (x.reshape(*batch, *x.shape[1:]) for x in (state, weight.log(), uniforms))
    new, log_weight = Adaptive(scheme, 0.75)(*shaped)
    new, log_weight = new.reshape(5, 11, 3), log_weight.reshape(5, 11)
    for i in range(5):
        expected = (state[i], weight[i].log()) if i in (1, 4) else scheme(state[i], weight[i].log(), uniforms[i])
        assert torch.equal(new[i], expected[0])
        assert torch.equal(log_weight[i], expected[1])


@pytest.mark.parametrize("batch", [(), (3,)])
def test_threshold_zero_never_resamples(batch):
    log_weight = torch.full((*batch, 7), -torch.inf)
    log_weight[..., 2] = 0
    state = torch.randn(*batch, 7, 2)
    new, kept = Adaptive(systematic, 0)(state, log_weight, torch.full((*batch, 1), 0.5))
    assert torch.equal(new, state)
    assert torch.equal(kept, log_weight)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_threshold_one_resamples_whatever_is_not_equal(batch):
    log_weight = torch.zeros(*batch, 7)
    log_weight[..., 2] = 0.01
    _, new = Adaptive(systematic, 1)(
        torch.randn(*batch, 7, 2), log_weight.log_softmax(-1), torch.full((*batch, 1), 0.5)
    )
    torch.testing.assert_close(new, torch.full((*batch, 7), -torch.tensor(7.0).log().item()))


def test_gradients_reach_resampled_and_untouched_clouds():
    weight = torch.tensor([[0.7, 0.1, 0.1, 0.1], [0.3, 0.2, 0.2, 0.3]])
    state = torch.randn(2, 4, 3, requires_grad=True)
    log_weight = weight.log().requires_grad_()
    new, new_log_weight = Adaptive(systematic)(state, log_weight, torch.full((2, 1), 0.4))
    (new.sum() + new_log_weight.sum()).backward()
    torch.testing.assert_close(state.grad[:, :, 0], torch.tensor([[3.0, 0, 1, 0], [1, 1, 1, 1]]))
    torch.testing.assert_close(log_weight.grad, torch.tensor([[0.0, 0, 0, 0], [1, 1, 1, 1]]))


@each_scheme
def test_adaptive_asks_for_the_uniforms_of_its_scheme(name):
    assert Adaptive(SCHEMES[name]).num_uniforms(9, 4) == (1 if name == "systematic" else 9)


@pytest.mark.parametrize("bad", [-0.1, 1.1, 2, float("nan"), float("inf")])
def test_rejects_a_threshold_that_is_no_share(bad):
    with pytest.raises(InputError, match=r"threshold must be in \[0, 1\]"):
        Adaptive(systematic, bad)
