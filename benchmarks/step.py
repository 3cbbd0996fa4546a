"""Time of one filter step: Jacobian blocks of one-landmark models against the dense Jacobian.

    python benchmarks/step.py

Both do the same work on the same states (planar, 12 landmarks seen, a batch of runs) and are
checked to give the same result. The dense one takes `jax.jacfwd` of the whole stack of
measurements and of the whole composed state, and multiplies full matrices.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import write_json
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.forms.state import State
from jaxslam.filters.model import Context
from jaxslam.geometry import difference, retract
from jaxslam.models.observations import Features
from jaxslam.simulation import Room, features, simulate

SEEN = 12
"""Landmarks measured in a frame."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    landmarks: str = "inverse_scaling"
    """Landmark parametrization."""
    maps: tuple[int, ...] = (12, 36)
    """Landmarks in the map, of which 12 are seen."""
    batch: int = 100
    """Runs in one batch."""
    steps: int = 20
    """Steps in one call."""
    repeats: int = 7
    """Timed calls; the median counts."""
    out: Path = Path("benchmarks/results")
    """Folder of step.json."""


def dense_step(f: EkfSlam, state: State, dt, seen: Features) -> State:
    """Predict, update and compose with dense Jacobians of everything at once."""
    state, model = f.predict(state, dt), f.model
    context, c = Context(dt), state.core_dim

    def moved(delta):
        landmarks = state.landmarks + delta[c:].reshape(state.landmarks.shape)
        return retract(state.core, delta[:c]), landmarks

    def stack(delta):
        core, landmarks = moved(delta)
        view = model.view(core, context)
        return jax.vmap(lambda x: model.observe(view, x, context)[0])(landmarks[seen.slots]).ravel()

    zero = jnp.zeros(state.covariance.shape[0])
    valid = jnp.repeat(seen.valid, seen.measured.shape[1])
    H = jnp.where(valid[:, None], jax.jacfwd(stack)(zero), 0.0)
    residual = jnp.where(valid, seen.measured.ravel() - stack(zero), 0.0)
    R = jnp.diag(jnp.where(valid, f.sensor.sigma**2, 1.0))
    P = state.covariance
    S = H @ P @ H.T + R
    K = jnp.linalg.solve(S, H @ P).T
    left = jnp.eye(zero.size) - K @ H
    core, landmarks = moved(K @ residual)
    state = replace(
        state, core=core, landmarks=landmarks, covariance=left @ P @ left.T + K @ R @ K.T
    )

    def composed(core, landmarks):
        view = model.view(core, context)
        move = partial(model.compose_landmark, view, context=context)
        return model.compose_core(core, context), jax.vmap(move)(landmarks)

    core, landmarks = composed(state.core, state.landmarks)

    def error(delta):
        c_new, l_new = composed(
            retract(state.core, delta[:c]),
            state.landmarks + delta[c:].reshape(state.landmarks.shape),
        )
        return jnp.concatenate([difference(c_new, core), (l_new - landmarks).ravel()])

    J = jax.jacfwd(error)(zero)
    return replace(state, core=core, landmarks=landmarks, covariance=J @ state.covariance @ J.T)


def block_step(f: EkfSlam, state: State, dt, seen: Features) -> State:
    """The filter's own step, nothing new seen."""
    state, _ = f.update(f.predict(state, dt), dt, seen)
    return f.compose(state, dt)


def prepared(options: Options, size: int):
    """Filter, seconds of a step, and a batch of started states with the features of all frames."""
    scenario = jaxslam.scenario("matched", steps=options.steps, landmarks=size)
    (f,) = jaxslam.make_filters(scenario, ["robocentric"], [options.landmarks]).values()
    room = Room(landmarks=size, first=size, known=SEEN, new=1)

    def start(key):
        run = simulate(scenario, key)
        first, seen, _ = features(run, room)
        return f.init(room.capacity, first), seen

    states, seen = jax.jit(jax.vmap(start))(jax.random.split(jax.random.key(0), options.batch))
    return f, jnp.asarray(1 / scenario.rate), states, seen


def timed(step, f, dt, states, seen, repeats):
    """Seconds to compile, median seconds of a call, and the final states."""

    @eqx.filter_jit
    def run(f, states, seen, dt):
        def one(state, seen):
            return jax.lax.scan(lambda s, x: (step(f, s, dt, x), None), state, seen)[0]

        return jax.vmap(one)(states, seen)

    start = time.perf_counter()
    compiled = run.lower(f, states, seen, dt).compile()  # ty: ignore[missing-attribute]
    compile_seconds = time.perf_counter() - start
    result = jax.block_until_ready(compiled(f, states, seen, dt))
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(f, states, seen, dt))
        seconds.append(time.perf_counter() - start)
    return compile_seconds, float(np.median(seconds)), result


def compare(options: Options, size: int) -> dict:
    """Both steps on a map of `size` landmarks."""
    f, dt, states, seen = prepared(options, size)
    compile_block, block, ours = timed(block_step, f, dt, states, seen, options.repeats)
    compile_dense, dense, theirs = timed(dense_step, f, dt, states, seen, options.repeats)
    difference_of_P = jnp.max(jnp.abs(ours.covariance - theirs.covariance))
    relative = float(difference_of_P / jnp.max(jnp.abs(theirs.covariance)))
    assert relative < 1e-8, f"the two steps differ: {relative:.1e} of the largest covariance"
    per_step = 1e6 / (options.batch * options.steps)
    return {
        "microseconds_per_step": {"blocks": block * per_step, "dense": dense * per_step},
        "compile_seconds": {"blocks": compile_block, "dense": compile_dense},
        "speedup": dense / block,
        "largest_relative_difference": relative,
    }


def main() -> None:
    """Measure, check, write."""
    options = tyro.cli(Options, description=__doc__)
    jax.config.update("jax_enable_x64", True)
    result = {
        "landmarks": options.landmarks,
        "batch": options.batch,
        "maps": {size: compare(options, size) for size in options.maps},
    }
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "step.json", result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
