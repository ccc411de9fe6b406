"""A vector environment in plain NumPy that can break any one rule on purpose."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv


class CountingVectorEnv(VectorEnv):
    """Environment i counts its steps up to 3 + i, next to a random number of the episode."""

    def __init__(self, mode: AutoresetMode, fault: str = "", num_envs: int = 3) -> None:
        self.fault, self.mode, self.num_envs = fault, mode, num_envs
        self.metadata = {"autoreset_mode": mode, "render_fps": 30}
        if fault == "no mode":
            del self.metadata["autoreset_mode"]
        if fault == "mode as text":
            self.metadata["autoreset_mode"] = mode.value
        if fault == "two modes":
            others = [other for other in AutoresetMode if other is not mode]
            self.autoreset_mode = others[0]
        self.render_mode = "rgb_array"
        self.single_observation_space = spaces.Box(0, 100, (2,), np.float64)
        self.observation_space = spaces.Box(0, 100, (num_envs, 2), np.float64)
        self.single_action_space = spaces.Discrete(2)
        self.action_space = spaces.MultiDiscrete([2] * num_envs)
        if fault == "observation space":
            self.observation_space = spaces.Box(0, 100, (num_envs, 3), np.float64)
        if fault == "bounds":
            self.observation_space = spaces.Box(0, 200, (num_envs, 2), np.float64)
        if fault == "action space":
            self.action_space = spaces.MultiDiscrete([3] * num_envs)
        self.state = np.zeros((num_envs, 2))
        self.done = np.zeros(num_envs, bool)
        self.buffer = np.zeros((num_envs, 2))

    def begin(self, mask):
        if self.fault == "unseeded":
            self.state[mask, 1] = np.random.default_rng().uniform(1, 99, mask.sum())
        else:
            self.state[mask, 1] = self.np_random.uniform(1, 99, mask.sum())
        self.state[mask, 0] = 0
        self.done[mask] = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mask = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options:
            mask = options["reset_mask"]
            if self.fault == "options":
                options.pop("reset_mask")
            if self.fault == "resets all":
                self.begin(np.ones(self.num_envs, bool))
                self.done[:] = False
                return self.obs(), self.infos()
            if self.fault == "resets others secretly":
                shown = self.obs()
                self.begin(np.ones(self.num_envs, bool))
                shown[mask] = self.state[mask]
                return shown, self.infos()
            if self.fault == "ignores mask":
                self.done[:] = False
                return self.obs(), self.infos()
            if self.fault == "writes mask":
                self.begin(mask)
                mask[:] = True
                return self.obs(), self.infos()
        self.begin(mask)
        return self.obs(), self.infos()

    def obs(self):
        obs = self.state.copy()
        if self.fault == "dtype":
            return obs.astype(np.float32)
        if self.fault == "shape":
            return obs[:, :1]
        if self.fault == "outside":
            return obs - 50
        if self.fault == "reuses memory":
            self.buffer[:] = obs
            return self.buffer
        return obs

    def infos(self):
        infos = {"count": self.state[:, 0].copy(), "_count": np.ones(self.num_envs, bool)}
        if self.fault == "no mask":
            del infos["_count"]
        if self.fault == "mask dtype":
            infos["_count"] = np.ones(self.num_envs)
        if self.fault == "info length":
            infos["count"] = infos["count"][:1]
        return [infos] if self.fault == "infos type" else infos

    def step(self, actions):
        begins = self.done.copy() if self.mode is AutoresetMode.NEXT_STEP else self.done & False
        self.state[~begins, 0] += 1
        ended = ~begins & (self.state[:, 0] >= 3 + np.arange(self.num_envs))
        reward = np.where(begins, 0.0, 1.0)
        if self.fault == "reward of a reset":
            reward[:] = 1.0
        if begins.any():
            self.begin(begins)
        self.done = ended.copy()
        if self.fault == "flags of a reset":
            ended = ended | begins
        infos, obs = {}, self.obs()
        if self.mode is AutoresetMode.SAME_STEP and ended.any():
            if self.fault != "no final_obs":
                rows = np.full(self.num_envs, None, object)
                for i in np.flatnonzero(ended):
                    rows[i] = obs[i] - 1000 if self.fault == "final_obs outside" else obs[i].copy()
                infos |= {"final_obs": rows, "_final_obs": ended.copy()}
            if self.fault == "final mask":
                infos["_final_obs"][:] = True
            if self.fault != "no final_info":
                infos |= {"final_info": self.infos(), "_final_info": ended.copy()}
            if self.fault != "never resets":
                self.begin(ended)
            obs = self.obs()
        if isinstance(more := self.infos(), dict):
            infos |= more
        else:
            infos = more
        truncated = np.zeros(self.num_envs, bool)
        if self.fault == "reward dtype":
            reward = reward.astype(int)
        if self.fault == "reward shape":
            reward = reward[:, None]
        if self.fault == "reward nan":
            reward[0] = np.nan
        if self.fault == "flag dtype":
            truncated = truncated.astype(int)
        if self.fault == "four results":
            return obs, reward, ended, infos
        return obs, reward, ended.copy(), truncated, infos

    def render(self):
        images = tuple(np.zeros((4, 5, 3), np.uint8) for _ in range(self.num_envs))
        if self.fault == "image array":
            return np.stack(images)
        if self.fault == "image dtype":
            return tuple(image.astype(float) for image in images)
        return images

    def close(self):
        if self.fault == "closes once" and self.closed:
            raise RuntimeError("closed already")
        if self.fault != "stays open":
            super().close()
            self.closed = True
