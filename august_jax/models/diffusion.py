r"""The diffusion of points: schedule, forward noising and two reverse samplers (paper, Section IV-C).

Forward: q(p_s | p_0) = N(sqrt(abar_s) p_0, (1 - abar_s) I), abar_s the running product of 1 - beta_s and beta_s
linear in s = 1..S. The paper prints sqrt(1 - abar_s) I as the covariance; that is the standard deviation, and the
noise estimator's definition a few lines on agrees with the covariance used here.

Reverse: `ancestral` takes the paper's S steps, p_{s-1} = (p_s - (1 - alpha_s)/sqrt(1 - abar_s) eps)/sqrt(alpha_s)
plus sqrt(beta~_s) times white noise. `dpm` is DPM-Solver++(2M) (Lu et al., 2022, Algorithm 2): with the half
log-SNR lambda = log(sqrt(abar)/sqrt(1 - abar)), h = lambda_next - lambda and the clean prediction
x = (p - sqrt(1 - abar) eps)/sqrt(abar),

    p_next = (sigma_next/sigma) p - alpha_next (e^{-h} - 1) [(1 + h/(2 h_last)) x - h/(2 h_last) x_last],

first order at its first step. Its steps lie evenly in lambda, rounded to whole s (the network never saw others),
from S down to 1; beyond s = 1 sigma is zero and the step is p_0 = x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Key

from august_jax.arrays import Array
from august_jax.mesh import own_rows

Denoise = Callable[[jax.Array, jax.Array], jax.Array]
"""(points (B, P, D), step s ()) -> estimated noise (B, P, D)."""

PointSampler = Callable[[Array, Denoise, tuple[int, int, int]], jax.Array]
"""(key, denoise, shape (B, P, D)) -> draws of that shape: a sampler with its schedule."""


@dataclass(frozen=True)
class Schedule:
    """S = ``steps`` noise levels, beta linear over ``beta``; hashable, so that it may be static under jit."""

    steps: int
    beta: tuple[float, float]

    @property
    def betas(self) -> Float[np.ndarray, " levels"]:
        """beta_s for s = 0..S, float64 (S + 1,); beta_0 = 0."""
        return np.concatenate([[0.0], np.linspace(*self.beta, self.steps)])

    @property
    def alpha_bars(self) -> Float[np.ndarray, " levels"]:
        """abar_s for s = 0..S, float64 (S + 1,); abar_0 = 1."""
        return np.cumprod(1.0 - self.betas)

    @property
    def half_log_snr(self) -> Float[np.ndarray, " steps"]:
        """lambda_s for s = 1..S, float64 (S,); decreasing."""
        bars = self.alpha_bars[1:]
        return 0.5 * (np.log(bars) - np.log1p(-bars))


def draw_steps(key: Key[Array, ""], count: int, schedule: Schedule) -> Int[jax.Array, " {count}"]:
    """One step s in 1..S a cloud, int32 (count,): each uniform, together spread evenly over the schedule.

    A common random shift of a regular grid has the same marginal as independent draws and less variance.
    """
    places = own_rows(lambda rows: (jax.random.uniform(key) + jnp.arange(rows) / rows) % 1.0, count)
    return jnp.minimum(1 + (places * schedule.steps).astype(jnp.int32), schedule.steps)


def draw_noise(
    key: Key[Array, ""], points: Float[Array, "batch points dimensions"]
) -> Float[jax.Array, "batch points dimensions"]:
    """Unit noise of the points' shape (B, P, D)."""
    return own_rows(lambda rows: jax.random.normal(key, (rows, *points.shape[1:])), len(points))


def add_noise(
    points: Float[Array, "batch points dimensions"],
    noise: Float[Array, "batch points dimensions"],
    step: Int[Array, " batch"],
    schedule: Schedule,
) -> Float[jax.Array, "batch points dimensions"]:
    """p_s (B, P, D) from p_0 (B, P, D), unit noise of that shape and the step s (B,) of each cloud."""
    bars = jnp.asarray(schedule.alpha_bars, points.dtype)[step][:, None, None]
    return jnp.sqrt(bars) * points + jnp.sqrt(1.0 - bars) * noise


def ancestral(
    key: Key[Array, ""],
    denoise: Denoise,
    shape: tuple[int, int, int],
    schedule: Schedule,
    instants: tuple[int, ...] = (),
) -> Float[jax.Array, "*instants batch points dimensions"]:
    """Clouds of ``shape`` (B, P, D) by the paper's S-step sampler.

    With ``instants``, counts of completed steps in 0..S, the clouds at those instants instead: (I, B, P, D). At S they
    are the clouds that the same key gives without.

    Raises:
        ValueError: an instant outside 0..S.
    """
    if any(not 0 <= done <= schedule.steps for done in instants):
        raise ValueError(f"instants: {instants} counts completed steps; each must lie in 0..{schedule.steps}")
    betas, bars = schedule.betas, schedule.alpha_bars
    steps = np.arange(schedule.steps, 0, -1)
    noise_scale = (1.0 - betas[steps]) ** -0.5 * betas[steps] / np.sqrt(1.0 - bars[steps])
    spread = np.sqrt((1.0 - bars[steps - 1]) / (1.0 - bars[steps]) * betas[steps])
    table = jnp.asarray(np.stack([(1.0 - betas[steps]) ** -0.5, noise_scale, spread], -1), jnp.float32)
    start_key, key = jax.random.split(key)
    start = jax.random.normal(start_key, shape)

    def reverse(points, row):
        step, (grow, remove, spread) = row
        fresh = jax.random.normal(jax.random.fold_in(key, step), shape)
        points = grow * points - remove * denoise(points, step) + spread * fresh
        return points, points if instants else None

    last, path = jax.lax.scan(reverse, start, (jnp.asarray(steps), table))
    return jnp.concatenate([start[None], path])[np.asarray(instants)] if instants else last


def dpm_steps(schedule: Schedule, evaluations: int) -> Int[np.ndarray, " {evaluations}"]:
    """The steps s that :func:`dpm` visits, int (evaluations,): S, ..., 1, about even in log-SNR.

    Raises:
        ValueError: fewer than 2 evaluations, or more than the schedule has steps.
    """
    if not 2 <= evaluations <= schedule.steps:
        raise ValueError(
            f"sampler_steps: {evaluations} evaluations do not fit a schedule of {schedule.steps} steps; "
            f"choose 2..{schedule.steps}"
        )
    lambdas = schedule.half_log_snr
    even = np.linspace(lambdas[-1], lambdas[0], evaluations)
    steps = np.rint(np.interp(even, lambdas[::-1], np.arange(schedule.steps, 0, -1))).astype(int)
    # Near s = 1 a whole step is wider than the even spacing: keep the steps distinct, from both ends.
    floor = np.arange(evaluations, 0, -1)
    slack = np.maximum.accumulate((steps - floor)[::-1])[::-1]
    return np.minimum(slack, schedule.steps - evaluations) + floor


def dpm(
    key: Key[Array, ""], denoise: Denoise, shape: tuple[int, int, int], schedule: Schedule, evaluations: int
) -> Float[jax.Array, "batch points dimensions"]:
    """Clouds of ``shape`` (B, P, D) by DPM-Solver++(2M) with that many network evaluations; see the module's top."""
    steps = dpm_steps(schedule, evaluations)
    bars = schedule.alpha_bars[steps]
    alpha, sigma, lambdas = np.sqrt(bars), np.sqrt(1.0 - bars), schedule.half_log_snr[steps - 1]
    width = np.diff(lambdas)
    momentum = np.concatenate([[0.0], width[1:] / (2.0 * width[:-1])])
    keep = sigma[1:] / sigma[:-1]
    move = -alpha[1:] * np.expm1(-width)
    clean_scale = np.stack([1.0 / alpha, sigma / alpha], -1)
    table = jnp.asarray(np.concatenate([clean_scale[:-1], np.stack([keep, move, momentum], -1)], -1), jnp.float32)
    start = jax.random.normal(key, shape)

    def reverse(carry, row):
        points, last = carry
        step, (grow, remove, keep, move, momentum) = row
        clean = grow * points - remove * denoise(points, step)
        points = keep * points + move * ((1.0 + momentum) * clean - momentum * last)
        return (points, clean), None

    (points, _), _ = jax.lax.scan(reverse, (start, jnp.zeros(shape)), (jnp.asarray(steps[:-1]), table))
    grow, remove = clean_scale[-1].astype(np.float32)
    return grow * points - remove * denoise(points, jnp.asarray(steps[-1]))
