"""One pixel environment: physics -> scene -> renderer -> observation."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.choices import check_choice, check_whole
from pixelbrax_jax.distractors.base import Chain, Distractor
from pixelbrax_jax.envs import observe
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.renderer.base import RENDERERS, render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.types import EnvParams, EnvState, Frame, Scene, Timestep

OBS_MODES = ("pixels", "state", "both")

_RESET_STREAM = 0
"""Name of the random stream of physics resets, folded into an episode's key."""

_BANDS = 2
"""Parts in which an accelerator draws a picture, one above the other: a loop of one is none."""


class PixelEnv:
    """A continuous-control task that is seen through a camera.

    Functional: ``reset`` and ``step`` are pure, jitted, and work under ``jax.vmap``, ``lax.scan``
    and a jit of your own. Everything that decides the program is an attribute; everything that
    may be randomised is in ``EnvParams``, an ordinary argument.

    All randomness of episode e comes from ``fold_in(key, e)``.

    Example:
        >>> env, params = pixelbrax_jax.make("ant")
        >>> state, timestep = env.reset(jax.random.key(0), params)
        >>> state, timestep = env.step(state, jnp.zeros(env.action_size), params)

    Attributes:
        physics: the physics engine with its task.
        height, width: pixels of one frame.
        frame_stack: frames in one observation.
        obs_mode: ``"pixels"``, ``"state"`` or ``"both"``.
        action_repeat: control steps per call of ``step``.
        episode_length: time limit, in control steps.
        distractors: what changes the picture, a ``Chain``; empty without pixels.
    """

    def __init__(
        self,
        physics: Physics,
        *,
        height: int = 84,
        width: int = 84,
        frame_stack: int = 3,
        obs_mode: str = "pixels",
        action_repeat: int = 1,
        episode_length: int = 1000,
        renderer: str = "fused",
        distractors: tuple[Distractor, ...] = (),
    ) -> None:
        """Checks the options.

        Args:
            physics: the physics engine with its task.
            height: pixels, at least 1.
            width: pixels, at least 1.
            frame_stack: frames in one observation, at least 1.
            obs_mode: ``"pixels"``, ``"state"`` (nothing is rendered) or ``"both"``.
            action_repeat: control steps per call of ``step``, at least 1.
            episode_length: time limit in control steps, at least 1.
            renderer: ``"fused"`` or ``"reference"``.
            distractors: what changes the picture; at most one of a kind.

        Raises:
            ValueError: an option is out of range; the message says what is allowed.
            MemoryError: frames would not fit into this machine's memory.
        """
        self.physics = physics
        self.height = check_whole("height", height)
        self.width = check_whole("width", width)
        self.frame_stack = check_whole("frame_stack", frame_stack)
        self.obs_mode = check_choice("obs_mode", obs_mode, OBS_MODES)
        self.action_repeat = check_whole("action_repeat", action_repeat)
        self.episode_length = check_whole("episode_length", episode_length)
        self.renderer = check_choice("renderer", renderer, RENDERERS)
        self.distractors = Chain(distractors if obs_mode != "state" else ())
        self.check_memory(1)

    @property
    def action_size(self) -> int:
        """Length A of an action, a (A,) float32 vector in [-1, 1]."""
        return self.physics.action_size

    @property
    def dt(self) -> float:
        """Seconds of simulated time per call of ``step``."""
        return self.physics.dt * self.action_repeat

    @property
    def obs_spec(self) -> Any:
        """Shape and dtype of an observation, as ``jax.ShapeDtypeStruct``."""
        pixels = jax.ShapeDtypeStruct((self.height, self.width, 3 * self.frame_stack), jnp.uint8)
        state = jax.ShapeDtypeStruct((self.physics.state_size,), jnp.float32)
        both = {"pixels": pixels, "state": state}
        return both if self.obs_mode == "both" else both[self.obs_mode]

    def check_memory(self, num_envs: int) -> None:
        """Reject sizes that cannot fit into this machine's main memory.

        Args:
            num_envs: how many environments are stepped together.

        Raises:
            MemoryError: observations and states of two steps, which are there at the same time,
                take more bytes than the machine has.
        """
        numbers = 2 * self.physics.state_size + 7 * len(self.physics.link_names)
        what, num_bytes = f"num_envs={num_envs}", 8 * num_envs * numbers
        if self.obs_mode != "state":
            num_bytes += 2 * num_envs * self.height * self.width * 3 * self.frame_stack
            what += f", height={self.height}, width={self.width}, frame_stack={self.frame_stack}"
        check_fits(what, num_bytes)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        """Begins episode 0 of the environment that ``key`` stands for.

        Args:
            key: a typed PRNG key, ``jax.random.key(seed)``.
            params: what may be randomised.

        Returns:
            The state and the first timestep, with reward 0.

        Raises:
            TypeError: ``key`` is not a single typed key.
        """
        check_key(key)
        state = self.begin(key, jnp.uint32(0), params)
        state = self.show(state, params, jnp.bool_(True))
        return state, self.timestep(state, jnp.float32(0.0))

    @partial(jax.jit, static_argnums=0)
    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """Acts for ``action_repeat`` control steps and draws one frame.

        Nothing resets by itself: when ``state.done`` is set, call ``reset`` or ``next_episode``,
        or let ``VectorPixelEnv`` do so.

        Args:
            state: the current state.
            action: (A,) float; clipped to [-1, 1] before physics and control cost. A NaN ends the
                episode, with ``info["non_finite"]`` set.
            params: what may be randomised.

        Returns:
            The next state and timestep. The reward is the sum over the control steps up to the
            first termination or the time limit. ``info`` has

            * ``episode_return``: () float32, sum of this episode's rewards so far,
            * ``episode_length``: () int32, control steps so far,
            * ``non_finite``: () bool, the physics diverged; the episode is then terminated with
              reward 0 and the last finite pose is shown,

            and what the distractors tell of themselves.

        Raises:
            ValueError: ``action`` has another shape.
            TypeError: ``action`` is not floating point.
        """
        state, reward = self.advance(state, action, params)
        state = self.show(state, params, jnp.bool_(False))
        return state, self.timestep(state, reward)

    @partial(jax.jit, static_argnums=0)
    def next_episode(self, state: EnvState, params: EnvParams) -> tuple[EnvState, Timestep]:
        """Begins the environment's next episode, from a fresh draw.

        Args:
            state: any state of the environment.
            params: what may be randomised.

        Returns:
            The state and the first timestep, with reward 0.
        """
        state = self.begin(state.key, state.episode + 1, params)
        state = self.show(state, params, jnp.bool_(True))
        return state, self.timestep(state, jnp.float32(0.0))

    @partial(jax.jit, static_argnums=(0, 3, 4))
    def render(
        self,
        state: EnvState,
        params: EnvParams,
        height: int | None = None,
        width: int | None = None,
    ) -> Frame:
        """The float frame of a state, at any size, distractors included.

        Args:
            state: the state to draw.
            params: what may be randomised.
            height: pixels, the observation's by default.
            width: pixels, the observation's by default.

        Returns:
            Colors, depth and segmentation.
        """
        height, width = self._size(height, width)
        frame = render(self._scene(state, params), height, width, self.renderer)
        rows = jnp.arange(height)
        backdrops = self.distractors.backdrops(state.distraction, params, rows, height, width)
        return self.distractors.change_frame(state.distraction, frame, backdrops)

    @partial(jax.jit, static_argnums=(0, 3, 4))
    def picture(
        self,
        state: EnvState,
        params: EnvParams,
        height: int | None = None,
        width: int | None = None,
    ) -> jax.Array:
        """A state as pixels, rounded like an observation, at any size.

        Args:
            state: the state to draw.
            params: what may be randomised.
            height: pixels, the observation's by default.
            width: pixels, the observation's by default.

        Returns:
            (height, width, 3) uint8, row 0 at the top.
        """
        height, width = self._size(height, width)
        return observe.unpack(self.draw_at(state, params, height, width))

    # The pieces of a step, which `VectorPixelEnv` puts together in another order.

    def begin(self, key: jax.Array, episode: jax.Array, params: EnvParams) -> EnvState:
        """The state at the start of an episode, with nothing drawn yet."""
        episode_key = jax.random.fold_in(key, episode)
        shape = (self.height, self.width, 3 * self.frame_stack)
        return EnvState(
            physics=self.physics.reset(jax.random.fold_in(episode_key, _RESET_STREAM)),
            frames=jnp.zeros((0, 0, 0) if self.obs_mode == "state" else shape, jnp.uint8),
            key=key,
            episode=episode,
            step_count=jnp.int32(0),
            head_start=jnp.int32(0),
            episode_return=jnp.float32(0.0),
            done=jnp.bool_(False),
            distraction=self.distractors.begin(episode_key, params),
        )

    def advance(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, jax.Array]:
        """The state after the action, with nothing drawn yet, and the reward."""
        action = self._check_action(action)

        def control_step(carry: Any, _: None) -> tuple[Any, None]:
            physics, reward, count, over = carry
            moved = self.physics.step(physics, action)
            physics = jax.tree.map(lambda old, new: jnp.where(over, old, new), physics, moved)
            reward += jnp.where(over, 0.0, moved.reward)
            count += jnp.where(over, 0, 1)
            return (physics, reward, count, over | moved.terminated | (count >= limit)), None

        limit = self.episode_length - state.head_start
        if self.action_repeat == 1:
            physics = self.physics.step(state.physics, action)
            reward, count = physics.reward, state.step_count + 1
        else:
            start = (state.physics, jnp.float32(0.0), state.step_count, jnp.bool_(False))
            (physics, reward, count, _), _ = jax.lax.scan(
                control_step, start, length=self.action_repeat
            )
        # The number of this frame in its episode; the last one may come early.
        frame = -(-count // self.action_repeat)
        episode_key = jax.random.fold_in(state.key, state.episode)
        state = state.replace(
            physics=physics,
            step_count=count,
            episode_return=state.episode_return + reward,
            done=physics.terminated | (count >= limit),
            distraction=self.distractors.advance(state.distraction, episode_key, frame, params),
        )
        return state, reward

    def draw(self, state: EnvState, params: EnvParams) -> jax.Array:
        """The packed frame of a state, (H, W) uint32."""
        return self.draw_at(state, params, self.height, self.width)

    def draw_at(self, state: EnvState, params: EnvParams, height: int, width: int) -> jax.Array:
        """The packed frame of a state at any size, (height, width) uint32."""
        scene = self._scene(state, params)

        # Both forms are walls that XLA does not fuse across: without one the renderer is fused
        # into whoever reads the words, and runs again for every reader.
        def draw_rows(first_row: jax.Array, num_rows: int) -> jax.Array:
            frame = render(
                scene, height, width, self.renderer, first_row=first_row, num_rows=num_rows
            )
            # The last band may reach beyond the picture.
            rows = jnp.minimum(first_row + jnp.arange(num_rows), height - 1)
            backdrops = self.distractors.backdrops(state.distraction, params, rows, height, width)
            return observe.pack(self.distractors.change_frame(state.distraction, frame, backdrops))

        def draw_in_bands() -> jax.Array:
            num_rows = -(-height // _BANDS)
            first_rows = jnp.arange(_BANDS) * num_rows
            words = jax.lax.map(lambda first_row: draw_rows(first_row, num_rows), first_rows)
            return words.reshape(-1, width)[:height]

        def draw_at_once() -> jax.Array:
            # On a CPU, XLA clears the result of a loop beforehand, and runs in one thread whatever
            # is fused into the writes to it. A conditional costs nothing; were it known to be
            # always taken, the compiler would remove it, and the wall with it.
            zero = jax.lax.optimization_barrier(jnp.int32(0))
            blank = jnp.zeros(height * width, jnp.uint32)
            # In one axis, as the renderer computes it.
            words = jax.lax.cond(zero == 0, lambda: draw_rows(zero, height).ravel(), lambda: blank)
            return words.reshape(height, width)

        words: jax.Array = jax.lax.platform_dependent(cpu=draw_at_once, default=draw_in_bands)
        return words

    def show(self, state: EnvState, params: EnvParams, first: jax.Array) -> EnvState:
        """``state`` with its present frame on the stack."""
        if self.obs_mode == "state":
            return state
        newest = self.draw(state, params)
        return state.replace(frames=observe.push(state.frames, newest, first))

    def timestep(self, state: EnvState, reward: jax.Array) -> Timestep:
        """What the agent sees of ``state``."""
        terminated = state.physics.terminated
        return Timestep(
            obs=self.obs(state),
            reward=reward,
            terminated=terminated,
            truncated=~terminated & (state.step_count + state.head_start >= self.episode_length),
            info={
                "episode_return": state.episode_return,
                "episode_length": state.step_count,
                "non_finite": state.physics.non_finite,
                **self.distractors.info(state.distraction),
            },
        )

    def obs(self, state: EnvState) -> Any:
        """The observation of ``state``, as ``obs_mode`` says."""
        if self.obs_mode == "state":
            return state.physics.obs
        if self.obs_mode == "pixels":
            return state.frames
        return {"pixels": state.frames, "state": state.physics.obs}

    def _size(self, height: int | None, width: int | None) -> tuple[int, int]:
        return (
            self.height if height is None else check_whole("height", height),
            self.width if width is None else check_whole("width", width),
        )

    def _scene(self, state: EnvState, params: EnvParams) -> Scene:
        params = self.distractors.change_params(state.distraction, params)
        physics = state.physics
        return place(params.geoms, params.rig, params.look, physics.xpos, physics.xquat)

    def _check_action(self, action: jax.Array) -> jax.Array:
        action = jnp.asarray(action)
        if action.shape != (self.action_size,):
            raise ValueError(
                f"action must have shape ({self.action_size},), got {tuple(action.shape)}."
            )
        if not jnp.issubdtype(action.dtype, jnp.floating):
            raise TypeError(f"action must be floating point in [-1, 1], got {action.dtype}.")
        return jnp.clip(action.astype(jnp.float32), -1.0, 1.0)


def check_key(key: jax.Array, shape: tuple[int, ...] = ()) -> None:
    """Rejects anything but typed PRNG keys of the given shape.

    Raises:
        TypeError: it is not, with the cure.
    """
    is_array = isinstance(key, jax.Array)
    if not (is_array and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        # An array's type is no help: under jit it is a tracer, which the caller has not made.
        got = f"{key.dtype}{list(key.shape)}" if is_array else type(key).__name__
        raise TypeError(
            f"key must come from jax.random.key(seed), got {got}; jax.random.wrap_key_data turns "
            "one of jax.random.PRNGKey into such a key."
        )
    if key.shape != shape:
        raise TypeError(f"key must have shape {shape}, got {key.shape}.")
