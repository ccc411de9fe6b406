"""Layers written anew equal the plain ones; encoders; distributions against integrals."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from scipy import integrate, stats

from pixelbrax_jax.agents.networks.actor_critic import POLICIES, Actor, Critic
from pixelbrax_jax.agents.networks.convolution import convolve
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.networks.encoders import ENCODERS, SMALLEST, centered, max_pool


def plain_max_pool(x):
    return nn.max_pool(x, (3, 3), strides=(2, 2), padding="SAME")


@pytest.mark.parametrize(("height", "width"), [(5, 8), (12, 7)])
def test_max_pool_and_its_gradient_are_flax_s_without_a_scatter(height, width):
    x = jax.random.normal(jax.random.key(0), (2, height, width, 3))
    np.testing.assert_array_equal(max_pool(x), plain_max_pool(x))

    def gradient(pool):
        # Without ties there is only one.
        slope = jnp.arange(1.0, 1.0 + max_pool(x).size).reshape(max_pool(x).shape)
        return jax.jit(jax.grad(lambda x: jnp.sum(pool(x) * slope)))

    np.testing.assert_array_equal(gradient(max_pool)(x), gradient(plain_max_pool)(x))
    assert "scatter" in gradient(plain_max_pool).lower(x).as_text()
    assert "scatter" not in gradient(max_pool).lower(x).as_text()


CONVOLUTIONS = [
    # size, kernel, stride, padding: of impala, nature, drq and small; a stride of 4 and
    # one of 2 do not reach the last pixels.
    (9, 3, 1, "SAME"),
    (39, 8, 4, "VALID"),
    (10, 4, 2, "VALID"),
    (7, 3, 1, "VALID"),
    (16, 3, 2, "VALID"),
]


@jax.jit
def convolutions(key):
    """Value and gradients by case, of ours and of JAX's convolution; in one program."""

    def both(size, kernel, stride, padding):
        keys = jax.random.split(key, 3)
        # Another width than height: the two must not be mixed up.
        x = jax.random.normal(keys[0], (2, size, size + 1, 3))
        weights = jax.random.normal(keys[1], (kernel, kernel, 3, 5))
        pads = jax.lax.padtype_to_pads(x.shape[1:3], (kernel,) * 2, (stride,) * 2, padding)
        plain = partial(
            jax.lax.conv_general_dilated, window_strides=(stride,) * 2, padding=padding,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )  # fmt: skip
        for function in (partial(convolve, stride=stride, pads=tuple(pads)), plain):
            value, pull = jax.vjp(function, x, weights)
            yield value, *pull(jax.random.normal(keys[2], value.shape))

    return [tuple(both(*case)) for case in CONVOLUTIONS]


def test_convolutions_and_their_gradients_are_jax_s():
    for ours, plain in convolutions(jax.random.key(5)):
        for actual, expected in zip(ours, plain, strict=True):
            assert actual.shape == expected.shape
            # Sums of up to some thousand products, in another order.
            scale = float(jnp.abs(expected).max())
            np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5 * scale)


def test_pixels_are_scaled_before_they_are_convolved():
    """Also where bytes are rearranged first, and where zeros surround the scaled pixels."""

    def both(key, size, kernel, stride, padding):
        keys = jax.random.split(key)
        pixels = jax.random.randint(keys[0], (2, size, size + 1, 3), 0, 256).astype(jnp.uint8)
        weights = jax.random.normal(keys[1], (kernel, kernel, 3, 5))
        pads = jax.lax.padtype_to_pads(pixels.shape[1:3], (kernel,) * 2, (stride,) * 2, padding)
        by = partial(convolve, stride=stride, pads=tuple(pads))
        x = pixels.astype(jnp.float32) / 255.0 - 0.5
        for function in (partial(by, pixels, before=centered), partial(by, x)):
            value, pull = jax.vjp(function, weights)
            yield value, *pull(value)

    @jax.jit
    def convolved(key):
        return [tuple(both(key, *case)) for case in CONVOLUTIONS]

    for ours, plain in convolved(jax.random.key(6)):
        for actual, expected in zip(ours, plain, strict=True):
            scale = float(jnp.abs(expected).max())
            np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-6 * scale)


def test_a_convolution_differentiates_twice():
    keys = jax.random.split(jax.random.key(8))
    x, weights = jax.random.normal(keys[0], (1, 5, 6, 2)), jax.random.normal(keys[1], (3, 3, 2, 3))

    @jax.jit
    def both(x, weights):
        def second(function):
            def first(x):
                return jnp.sum(jax.grad(lambda x: jnp.sum(function(x, weights) ** 3))(x) ** 2)

            return jax.grad(first)(x)

        plain = partial(
            jax.lax.conv_general_dilated, window_strides=(1, 1), padding="VALID",
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )  # fmt: skip
        return second(partial(convolve, stride=1, pads=((0, 0), (0, 0)))), second(plain)

    actual, expected = both(x, weights)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4 * float(expected.max()))


def test_each_run_under_vmap_has_its_own_kernel():
    """Also in gradients; images under vmap share one."""
    keys = jax.random.split(jax.random.key(7), 3)
    x = jax.random.normal(keys[0], (2, 1, 7, 6, 3))
    weights = jax.random.normal(keys[1], (2, 3, 3, 3, 5))
    upper = jax.random.normal(keys[2], (2, 1, 5, 4, 5))

    @jax.jit
    def both(x, weights, upper):
        def pulled(x, weights, upper):
            value, pull = jax.vjp(partial(convolve, stride=1, pads=((0, 0), (0, 0))), x, weights)
            return value, *pull(upper)

        one_by_one = [pulled(*run) for run in zip(x, weights, upper, strict=True)]
        shared = jax.vmap(pulled, (0, None, 0))(x, weights[0], upper)
        return jax.vmap(pulled)(x, weights, upper), shared, one_by_one

    together, shared, one_by_one = both(x, weights, upper)
    for values, runs in ((together, (0, 1)), (shared, (0,))):
        for run in runs:
            for actual, expected in zip(values, one_by_one[run], strict=True):
                np.testing.assert_allclose(actual[run], expected, rtol=1e-5, atol=1e-5)


def inputs_of_last_layer(name: str, size: int) -> int:
    """Numbers that an encoder's dense layer gets of square images."""
    pixels = jnp.zeros((1, size, size, 3))
    params = jax.eval_shape(ENCODERS[name]().init, jax.random.key(0), pixels)["params"]
    return params["Dense_0"]["kernel"].shape[0]


@pytest.mark.parametrize("name", ["small", "patch"])
def test_encoders_of_ours_see_pixels_around_zero(name):
    """With pixels in [0, 1] nearly all filters of these went to zero under videos."""
    encoder, grey = ENCODERS[name](), jnp.ones((3, 24, 24, 3))  # depths, of which 1 m is grey
    weights = encoder.init(jax.random.key(0), grey)
    features = encoder.apply(weights, grey + jnp.array([0, 0.2, -0.2])[:, None, None, None])
    # Biases are zero at first, so that only what differs from grey is seen.
    np.testing.assert_array_equal(features.any(1), [False, True, True])


@pytest.mark.parametrize("name", ENCODERS)
def test_an_encoder_s_smallest_size_is_the_smallest(name):
    assert inputs_of_last_layer(name, SMALLEST[name]) > 0
    if SMALLEST[name] > 1:
        # A convolution that does not fit gives an empty image: features would be constant.
        assert inputs_of_last_layer(name, SMALLEST[name] - 1) == 0


# At 84 pixels: 11 x 11 x 32, 7 x 7 x 64, 35 x 35 x 32; at 64: 8 x 8 x 32.
@pytest.mark.parametrize(
    ("name", "size", "number"),
    [("impala", 84, 3872), ("impala", 64, 2048), ("nature", 84, 3136), ("drq", 84, 39200)],
)
def test_encoders_have_the_sizes_of_their_papers(name, size, number):
    assert inputs_of_last_layer(name, size) == number


def actor(policy: str, **options) -> tuple[Actor, dict]:
    network = Actor("small", 2, policy, **options)
    pixels = jax.random.randint(jax.random.key(3), (4, 18, 18, 3), 0, 256).astype(jnp.uint8)
    params = network.init(jax.random.key(0), pixels)
    return network.apply(params, pixels), params


@pytest.mark.parametrize("policy", POLICIES)
def test_a_new_policy_is_near_the_middle_and_as_wide_as_it_should_be(policy):
    output, _ = actor(policy, initial_std=0.7)
    assert float(jnp.abs(output.policy.mean).max()) < 0.1
    # softplus(0) + 0.001 is the start of "deacrep", whatever the setting.
    expected = np.log(2) + 0.001 if policy == "deacrep" else 0.7
    np.testing.assert_allclose(output.policy.std, expected, atol=0.03)
    assert output.policy.squash == (policy == "tanh_gaussian")
    assert output.value is None


def test_a_value_head_changes_nothing_else_of_a_new_actor():
    without, params = actor("gaussian")
    output, more = actor("gaussian", has_value=True)
    np.testing.assert_array_equal(output.policy.mean, without.policy.mean)
    assert set(more["params"]) - set(params["params"]) == {"value"}
    assert output.value.shape == (4,)


def test_networks_drawn_side_by_side_are_those_drawn_alone():
    pixels = jnp.zeros((1, 18, 18, 3), jnp.uint8)
    network = Actor("small", 2, "gaussian")
    draw = jax.jit(jax.vmap(lambda key: network.init(key, pixels)))
    keys = jax.random.split(jax.random.key(0), 7)
    many, one = draw(keys), network.init(keys[3], pixels)
    for a, b in zip(jax.tree.leaves(many), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(a[3], b, atol=1e-6)
    # A decomposition of a batch may stand still for ever on a CPU with few cores.
    program = draw.lower(keys).as_text()
    calls = [line for line in program.splitlines() if "geqrf" in line]
    assert calls
    assert not any("tensor<7x" in line for line in calls)


def test_log_std_is_clipped():
    network = Actor("small", 2, "gaussian")
    pixels = jnp.zeros((1, 18, 18, 3), jnp.uint8)
    params = network.init(jax.random.key(0), pixels)
    params["params"]["log_std"] = jnp.array([-50.0, 50.0])
    np.testing.assert_allclose(network.apply(params, pixels).policy.std[0], np.exp([-5, 2]))


def test_a_critic_of_states_ignores_pixels_and_the_scale_of_states():
    critic = Critic("small", sees_state=True)
    pixels = jnp.zeros((3, 18, 18, 3), jnp.uint8)
    state = jax.random.normal(jax.random.key(1), (3, 5))
    params = critic.init(jax.random.key(0), pixels, state)
    value = critic.apply(params, pixels, state)
    np.testing.assert_array_equal(value, critic.apply(params, pixels + 7, state))
    np.testing.assert_allclose(value, critic.apply(params, pixels, 1000 * state), atol=1e-4)
    assert len(set(np.asarray(value).tolist())) == 3


MEAN, STD = np.array([0.4, -1.1, 0.0]), np.array([0.3, 1.7, 0.9])
OTHER_MEAN, OTHER_STD = np.array([0.3, -0.2, 1.0]), np.array([1.5, 0.6, 1.0])


def normal(mean=MEAN, std=STD, squash=False) -> Normal:
    return Normal(jnp.asarray(mean, jnp.float32), jnp.asarray(std, jnp.float32), squash)


def test_log_prob_and_entropy_are_scipy_s():
    raw = np.random.default_rng(0).normal(size=(5, 3))
    expected = stats.norm(MEAN, STD).logpdf(raw).sum(-1)
    np.testing.assert_allclose(normal().log_prob(jnp.asarray(raw)), expected, rtol=1e-5)
    entropy = stats.norm(MEAN, STD).entropy().sum()
    assert float(normal().entropy(jax.random.key(0))) == pytest.approx(entropy, rel=1e-6)


@pytest.mark.parametrize("squash", [False, True])
def test_kl_is_the_integral_that_defines_it(squash):
    other = normal(MEAN + OTHER_MEAN, STD * OTHER_STD, squash)
    expected = 0.0
    for m, s, n, t in zip(MEAN, STD, other.mean.tolist(), other.std.tolist(), strict=True):
        old, new = stats.norm(m, s), stats.norm(n, t)
        expected += integrate.quad(
            lambda x, p=old, q=new: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), m - 9 * s, m + 9 * s
        )[0]
    old = normal(squash=squash)
    assert float(old.kl_to(other)) == pytest.approx(expected, rel=1e-5)
    assert float(old.kl_to(old)) == 0.0


def test_the_squashed_density_integrates_to_1_and_to_its_entropy():
    policy = normal([0.4], [0.8], squash=True)
    # Equal steps of the raw action: in terms of a = tanh(u) they crowd at the ends.
    raw = np.linspace(-6.0, 6.0, 4001, dtype=np.float32)
    action = np.tanh(raw.astype(np.float64))
    log_prob = np.asarray(policy.log_prob(jnp.asarray(raw)[:, None]), np.float64)
    density = np.exp(log_prob)
    assert integrate.trapezoid(density, action) == pytest.approx(1.0, abs=1e-4)
    entropy = -integrate.trapezoid(density * log_prob, action)
    keys = jax.random.split(jax.random.key(0), 20_000)
    drawn = jax.vmap(policy.entropy)(keys)
    # Four standard errors of the mean of one-draw estimates.
    assert float(drawn.mean()) == pytest.approx(
        entropy, abs=4 * float(drawn.std()) / len(keys) ** 0.5
    )


def test_the_squashed_density_stays_finite_far_out():
    policy = normal([0.0], [5.0], squash=True)
    far = jnp.array([[-40.0], [40.0]])
    assert np.isfinite(policy.log_prob(far)).all()
    gradient = jax.grad(lambda raw: policy.log_prob(raw).sum())(far)
    assert np.isfinite(gradient).all()


def test_samples_have_the_distribution_that_log_prob_tells():
    keys = jax.random.split(jax.random.key(4), 4000)
    drawn = np.asarray(jax.vmap(normal().sample)(keys))
    for i in range(3):
        assert stats.kstest(drawn[:, i], stats.norm(MEAN[i], STD[i]).cdf).pvalue > 1e-3
