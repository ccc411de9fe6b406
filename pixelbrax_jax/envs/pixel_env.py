"""One pixel environment: physics, scene, renderer and observation."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax._platform.frame_stack import push, unpack
from pixelbrax_jax.config import ProgramConfig
from pixelbrax_jax.distractors.base import Chain
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.envs.arguments import check_action, check_key
from pixelbrax_jax.flags import under_environment_flags
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.observations import IMAGES, MAX_DEPTH, image_of, parts_of
from pixelbrax_jax.physics.base import Physics, check_physics
from pixelbrax_jax.ranges import sample
from pixelbrax_jax.renderer.base import draw, render
from pixelbrax_jax.renderer.choice import why_no_kernel
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.types import Camera, EnvParams, EnvState, Frame, Scene, SimState, Timestep
from pixelbrax_jax.validation import check_positive_int

_RESET_STREAM, _DYNAMICS_STREAM = 0, 2**31
"""Random streams of physics resets and varied dynamics, folded into an episode's key."""


@dataclass(frozen=True)
class PixelEnv(ProgramConfig):
    """A continuous-control task that is observed through a camera.

    ``reset`` and ``step`` are pure and jitted, and work under ``jax.vmap``, ``lax.scan`` and
    ``jax.jit``. Fields decide the program: environments with equal fields are equal and share
    compiled programs. ``EnvParams``, an ordinary argument, has all that may be randomised.

    All randomness of episode e comes from ``fold_in(key, e)``.

    Examples:
        >>> env, params = pixelbrax_jax.make("ant")
        >>> state, timestep = env.reset(jax.random.key(0), params)
        >>> state, timestep = env.step(state, jnp.zeros(env.action_size), params)

    Attributes:
        physics: the physics with its task; further fields are those of ``ProgramConfig``.
            ``distractors`` may have one object of each kind and no names, and are left out without
            images.
        num_cameras: number of rigs in ``EnvParams.rig``.

    Raises:
        ValueError: a field is out of range; the message says what is allowed.
        TypeError: a field has another type, or is an array or tracer.
        MemoryError: frames do not fit into this machine's memory.
    """

    physics: Physics
    num_cameras: int = field(default=1, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_physics(self.physics)
        try:
            hash(self.physics)
        except TypeError as error:
            raise TypeError(
                f"physics must be hashable, got a {type(self.physics).__name__}: make it a frozen "
                "dataclass, or do not override its __eq__."
            ) from error
        self._store("num_cameras", check_positive_int("num_cameras", self.num_cameras))
        if self.camera_sizes and len(self.camera_sizes) != self.num_cameras:
            count = len(self.camera_sizes)
            raise ValueError(f"camera_sizes has {count} cameras, num_cameras={self.num_cameras}.")
        chain = Chain(as_tuple(self.distractors) if self.images else ())
        self._store("distractors", chain.links)
        self._check_distractors()
        self.check_memory(1)
        if self.renderer == "auto" and self.images:
            why_no_kernel()  # on a GPU, checks the kernel before a program is traced

    def _check_distractors(self) -> None:
        for link in self.chain.links:
            if link.only_colors and "pixels" not in self.images:
                raise ValueError(
                    f"distractor {link.kind!r} changes only colors, which obs_mode="
                    f"{self.obs_mode!r} does not show: leave it out, or add 'pixels' to obs_mode."
                )
            if link.one_camera and self.num_cameras > 1:
                raise ValueError(
                    f"distractor {link.kind!r} moves one camera, but there are {self.num_cameras}: "
                    "leave it out, or give one camera."
                )

    @cached_property
    def chain(self) -> Chain:
        """The chain of all distractors."""
        return Chain(as_tuple(self.distractors))

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
        parts: dict[str, Any] = self._stacks
        if "state" in parts_of(self.obs_mode):
            state = jax.ShapeDtypeStruct((self.physics.state_size,), jnp.float32)
            parts = parts | {"state": state}
        return _bare(parts)

    @property
    def drawn_spec(self) -> Any:
        """Shape and dtype of what ``draw_obs`` returns, as ``jax.ShapeDtypeStruct``."""
        cameras = (self.num_cameras,) if self.num_cameras > 1 and not self.camera_sizes else ()
        drawn = {
            name: jax.ShapeDtypeStruct((*cameras, *stack.shape[:2]), image_of(name).drawn)
            for name, stack in self._stacks.items()
        }
        return _bare(drawn)

    @cached_property
    def _stacks(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shape and dtype of each image's frame stack."""
        entries = {f"{n}/{c}": size for n in self.images for c, size in self.image_sizes.items()}
        entries = entries or dict.fromkeys(self.images, self._size())
        frames = self.frame_stack * (1 if self.camera_sizes else self.num_cameras)
        stacks = {}
        for name, size in entries.items():
            channels, dtype, _ = image_of(name)
            stacks[name] = jax.ShapeDtypeStruct((*size, channels * frames), dtype)
        return stacks

    def check_memory(self, num_envs: int) -> None:
        """Raise MemoryError if observations and states of two steps do not fit into main memory."""
        numbers = 2 * self.physics.state_size + 7 * len(self.physics.link_names)
        what, num_bytes = f"num_envs={num_envs}", 8 * num_envs * numbers
        if self.images:
            stacks = self._stacks.values()
            num_bytes += 2 * num_envs * sum(x.size * x.dtype.itemsize for x in stacks)
            size = (
                f"camera_sizes={self.camera_sizes}"
                if self.camera_sizes
                else f"height={self.height}, width={self.width}"
            )
            what += f", {size}, frame_stack={self.frame_stack}"
        check_fits(what, num_bytes)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def reset(self, key: jax.Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        """Reset to episode 0 of the environment with a typed PRNG key, ``jax.random.key(seed)``.

        The reward is 0. Raises TypeError if ``key`` is not a single typed key.
        """
        check_key(key)
        return self._reset(key, jnp.uint32(0), params)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """Step for ``action_repeat`` control steps and render one frame.

        The environment does not reset itself: when ``state.done`` is set, call ``reset`` or
        ``next_episode``, or use ``VectorPixelEnv``.

        Args:
            state: the current state.
            action: (A,) float, clipped to [-1, 1] before physics and control cost. A NaN ends the
                episode, with ``info["non_finite"]`` set.
            params: the parameters.

        Returns:
            The next state and timestep. The reward is the sum over the control steps up to the
            first termination or the time limit. ``info`` has

            * ``episode_return``: () float32, sum of this episode's rewards so far,
            * ``episode_length``: () int32, control steps so far,
            * ``non_finite``: () bool, the physics diverged; the episode is then terminated with
              reward 0 and the last finite pose is rendered,

            and the info of the distractors.

        Raises:
            ValueError: ``action`` has another shape.
            TypeError: ``action`` is not floating point.
        """
        action = check_action(action, (self.action_size,))
        sim, reward = self.advance(state.sim, state.key, action, params)
        frames = self.push_frame(state.frames, sim, jnp.bool_(False), params)
        state = state.replace(sim=sim, frames=frames)
        return state, self.timestep(state, reward, params)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def next_episode(self, state: EnvState, params: EnvParams) -> tuple[EnvState, Timestep]:
        """Reset to the environment's next episode."""
        return self._reset(state.key, state.sim.episode + 1, params)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def from_qpos(
        self, qpos: jax.Array, qvel: jax.Array | None, key: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """Reset as ``reset(key, params)`` does, but to a chosen pose.

        Args:
            qpos: (Q,) float, joint positions in MuJoCo's order: metres, radians, quaternions.
            qvel: (V,) float, joint velocities, per second; None for rest.
            key: a typed PRNG key, for targets and distractors.
            params: the parameters.

        Returns:
            The state and the first timestep, terminated only if the pose is not finite; the next
            step may be.

        Raises:
            ValueError: ``qpos`` or ``qvel`` has another shape.
            TypeError: ``key`` is not a single typed key, or the physics has no ``from_qpos``.
        """
        check_key(key)
        return self._reset(key, jnp.uint32(0), params, (qpos, qvel))

    def _reset(
        self, key: jax.Array, episode: jax.Array, params: EnvParams, pose: Any = None
    ) -> tuple[EnvState, Timestep]:
        sim = self.reset_sim(key, episode, params, pose)
        frames = self.push_frame(self.blank_frames(), sim, jnp.bool_(True), params)
        state = EnvState(sim=sim, frames=frames, key=key)
        return state, self.timestep(state, jnp.float32(0.0), params)

    @partial(jax.jit, static_argnums=(0, 3, 4))
    @under_environment_flags
    def render(
        self,
        state: EnvState,
        params: EnvParams,
        height: int | None = None,
        width: int | None = None,
    ) -> Frame:
        """Render a state with its distractors; height and width default to the observation's.

        With several cameras, the first one's view.
        """
        height, width = self._size(height, width)
        scene = self._scene(state.sim, params)
        frame = render(scene, height, width, self.renderer, samples=self.samples)
        rows, distractor_state = jnp.arange(height), state.sim.distractor_state
        return self.chain.change_frame(distractor_state, params, frame, rows, height, width)

    @partial(jax.jit, static_argnums=(0, 3, 4))
    @under_environment_flags
    def image(
        self,
        state: EnvState,
        params: EnvParams,
        height: int | None = None,
        width: int | None = None,
    ) -> jax.Array:
        """Render a state like ``render``, but to (height, width, 3) uint8, as in an observation."""
        height, width = self._size(height, width)
        return unpack(self.draw(state.sim, params, height, width))

    # The parts of a step, which `VectorPixelEnv` calls in another order.

    def reset_sim(
        self, key: jax.Array, episode: jax.Array, params: EnvParams, pose: Any = None
    ) -> SimState:
        """Return the first state of an episode, at the given joint positions if any."""
        episode_key = jax.random.fold_in(key, episode)
        physics_key = jax.random.fold_in(episode_key, _RESET_STREAM)
        physics: Any = self.physics
        varied = {}
        if params.dynamics is not None:
            if not physics.varies:
                raise ValueError(
                    f"params.dynamics must be None: a {type(physics).__name__} does not vary."
                )
            dynamics_key = jax.random.fold_in(episode_key, _DYNAMICS_STREAM)
            varied["dynamics"] = sample(params.dynamics, dynamics_key)
        if pose is None:
            first = physics.reset(physics_key, *varied.values())
        else:
            first = physics.from_qpos(*pose, key=physics_key, **varied)
        return SimState(
            physics=first,
            episode=episode,
            step_count=jnp.int32(0),
            time_limit_offset=jnp.int32(0),
            episode_return=jnp.float32(0.0),
            done=jnp.bool_(False),
            distractor_state=self.chain.reset(episode_key, params),
        )

    def advance(
        self, sim: SimState, key: jax.Array, action: jax.Array, params: EnvParams
    ) -> tuple[SimState, jax.Array]:
        """Return the state after the action, and the reward; ``key`` is the environment's."""
        action = jnp.clip(action.astype(jnp.float32), -1.0, 1.0)

        def control_step(carry: Any, _: None) -> tuple[Any, None]:
            physics, reward, count, over = carry
            moved = self.physics.step(physics, action)
            physics = jax.tree.map(lambda old, new: jnp.where(over, old, new), physics, moved)
            reward += jnp.where(over, 0.0, moved.reward)
            count += jnp.where(over, 0, 1)
            return (physics, reward, count, over | moved.terminated | (count >= limit)), None

        limit = params.episode_length - sim.time_limit_offset
        if self.action_repeat == 1:
            physics = self.physics.step(sim.physics, action)
            reward, count = physics.reward, sim.step_count + 1
        else:
            start = (sim.physics, jnp.float32(0.0), sim.step_count, jnp.bool_(False))
            (physics, reward, count, _), _ = jax.lax.scan(
                control_step, start, length=self.action_repeat
            )
        # The index of this frame in its episode; the last one may come early.
        frame = -(-count // self.action_repeat)
        episode_key = jax.random.fold_in(key, sim.episode)
        sim = sim.replace(
            physics=physics,
            step_count=count,
            episode_return=sim.episode_return + reward,
            done=physics.terminated | (count >= limit),
            distractor_state=self.chain.advance(sim.distractor_state, episode_key, frame, params),
        )
        return sim, reward

    def draw(
        self, sim: SimState, params: EnvParams, height: int | None = None, width: int | None = None
    ) -> jax.Array:
        """Render a state to (height, width) uint32 packed pixels, of the first camera."""
        size = self._size(height, width)
        (pixels,) = self._draw(self._scene(sim, params), sim, params, *size, ("pixels",))
        return pixels

    def draw_obs(self, sim: SimState, params: EnvParams) -> Any:
        """Render the images of an observation, as ``drawn_spec`` says."""
        scenes = [self._scene(sim, params, camera) for camera in range(self.num_cameras)]

        def image(scene: Scene, size: tuple[int, int]) -> tuple[jax.Array, ...]:
            return self._draw(scene, sim, params, *size, self.images)

        def of_view(camera: Camera, sky_xmat: Any) -> tuple[jax.Array, ...]:
            return image(scenes[0].replace(camera=camera, sky_xmat=sky_xmat), self._size())

        drawn: Any
        if self.camera_sizes:
            by_camera = map(image, scenes, self.image_sizes.values())
            drawn = [part for parts in zip(*by_camera, strict=True) for part in parts]
        elif len(scenes) > 1:
            views = [(scene.camera, scene.sky_xmat) for scene in scenes]
            drawn = jax.vmap(of_view)(*jax.tree.map(lambda *x: jnp.stack(x), *views))
        else:
            drawn = image(scenes[0], self._size())
        images = dict(zip(self._stacks, drawn, strict=True))
        for name in (name for name in images if image_of(name) is IMAGES["depth"]):
            images[name] = jnp.minimum(images[name], MAX_DEPTH)
        return _bare(images)

    def _draw(
        self,
        scene: Scene,
        sim: SimState,
        params: EnvParams,
        height: int,
        width: int,
        images: tuple[str, ...],
    ) -> tuple[jax.Array, ...]:
        def change(frame: Frame, rows: jax.Array, state: Any, params: EnvParams) -> Frame:
            return self.chain.change_frame(state, params, frame, rows, height, width)

        given, whole = (sim.distractor_state, params), self.chain.whole_image
        return draw(scene, height, width, self.renderer, change, given, images, self.samples, whole)

    def blank_frames(self) -> Any:
        """Return frame stacks of zeros; an empty one without images."""
        if not self.images:
            return jnp.zeros((0, 0, 0), jnp.uint8)
        return _bare({name: jnp.zeros(x.shape, x.dtype) for name, x in self._stacks.items()})

    def push_frame(self, frames: Any, sim: SimState, is_first: jax.Array, params: EnvParams) -> Any:
        """Return the frame stacks with the images of a state, or K copies in a first state."""
        if not self.images:
            return frames
        return push_each(frames, self.draw_obs(sim, params), is_first)

    def timestep(self, state: EnvState, reward: jax.Array, params: EnvParams) -> Timestep:
        """Return the timestep of a state."""
        sim, terminated = state.sim, state.sim.physics.terminated
        limit_reached = sim.step_count + sim.time_limit_offset >= params.episode_length
        return Timestep(
            obs=self.obs(state),
            reward=reward,
            terminated=terminated,
            truncated=~terminated & limit_reached,
            info={
                "episode_return": sim.episode_return,
                "episode_length": sim.step_count,
                "non_finite": sim.physics.non_finite,
                **self.chain.info(sim.distractor_state),
            },
        )

    def obs(self, state: EnvState) -> Any:
        """Return the observation of a state according to ``obs_mode``."""
        if not self.images:
            return state.sim.physics.obs
        if "state" not in parts_of(self.obs_mode):
            return state.frames
        names = tuple(self._stacks)
        frames = state.frames if len(names) > 1 else {names[0]: state.frames}
        return {**frames, "state": state.sim.physics.obs}

    def _size(self, height: int | None = None, width: int | None = None) -> tuple[int, int]:
        return (
            self.height if height is None else check_positive_int("height", height),
            self.width if width is None else check_positive_int("width", width),
        )

    def _scene(self, sim: SimState, params: EnvParams, camera: int = 0) -> Scene:
        params = self.chain.change_params(sim.distractor_state, params)
        physics = sim.physics
        rigs = params.rig if isinstance(params.rig, tuple) else (params.rig,)
        if len(rigs) != self.num_cameras:
            raise ValueError(
                f"params.rig must have num_cameras={self.num_cameras} rigs, got {len(rigs)}."
            )
        return place(params.geoms, rigs[camera], params.look, physics.xpos, physics.xquat)


def push_each(frames: Any, newest: Any, is_first: jax.Array) -> Any:
    """Push the newest image of each frame stack, see ``push``."""
    return jax.tree.map(lambda stack, image: push(stack, image, is_first), frames, newest)


def _bare(parts: dict[str, Any]) -> Any:
    """Return the only entry of a dictionary, or the dictionary of several."""
    return parts if len(parts) > 1 else next(iter(parts.values()))
