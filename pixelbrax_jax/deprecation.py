"""Modules under the names that they had before; these go with the next release."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_AGENTS = "pixelbrax_jax.agents"

MOVED = {
    "pixelbrax_gym.check": "pixelbrax_gym.gymnasium.check",
    "pixelbrax_gym.dlpack": "pixelbrax_gym.interop.dlpack",
    "pixelbrax_gym.sb3_env": "pixelbrax_gym.sb3.vec_env",
    "pixelbrax_gym.single_env": "pixelbrax_gym.gymnasium.single_env",
    "pixelbrax_gym.torchrl_env": "pixelbrax_gym.torchrl.env",
    "pixelbrax_gym.vector_env": "pixelbrax_gym.gymnasium.vector_env",
    "pixelbrax_jax.physics.brax_physics": "pixelbrax_jax.physics.brax.engine",
    "pixelbrax_jax.physics.mjcf_task": "pixelbrax_jax.physics.brax.mjcf",
    "pixelbrax_jax.physics.tasks": "pixelbrax_jax.physics.brax.tasks",
    **{f"{_AGENTS}.{name}": f"{_AGENTS}.algorithms.{name}" for name in ("dcpg", "ppg", "ppo")},
    f"{_AGENTS}.presets": f"{_AGENTS}.algorithms.presets",
    **{
        f"{_AGENTS}.{name}": f"{_AGENTS}.core.{name}"
        for name in (
            "algorithm",
            "config",
            "distributions",
            "losses",
            "networks",
            "phasic",
            "returns",
            "rollout",
        )
    },
    **{
        f"{_AGENTS}.{name}": f"{_AGENTS}.runner.{name}"
        for name in ("checkpoint", "evaluate", "export", "record", "run_config", "train", "trained")
    },
}
"""Former name of each public module, and its name now."""

RENAMED = {
    f"{_AGENTS}.ppo.make_ppo": f"{_AGENTS}.algorithms.ppo.PPO",
    f"{_AGENTS}.ppo.ActorCritic": f"{_AGENTS}.core.actor_critic.ActorCritic",
    f"{_AGENTS}.ppg.make_ppg": f"{_AGENTS}.algorithms.ppg.PPG",
    f"{_AGENTS}.dcpg.make_dcpg": f"{_AGENTS}.algorithms.dcpg.DCPG",
    **{
        f"{_AGENTS}.algorithm.{name}": f"{_AGENTS}.core.train_state.{name}"
        for name in ("TrainState", "auxiliary_key", "update_key")
    },
    f"{_AGENTS}.algorithm.policy_metrics": f"{_AGENTS}.core.losses.policy_metrics",
    **{
        f"{_AGENTS}.{name}.make_train": f"{_AGENTS}.algorithms.registry.make_train"
        for name in ("dcpg", "ppg", "ppo")
    },
}
"""Former name of what has left its module or has another name there, and its name now."""


class _Former(MetaPathFinder, Loader):
    """Finds modules under their former names, with a DeprecationWarning."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """As ``MetaPathFinder.find_spec``."""
        del path, target
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """As ``Loader.exec_module``."""
        name = module.__name__
        warnings.warn(f"{name} is {MOVED[name]} now.", DeprecationWarning, stacklevel=2)
        present = vars(import_module(MOVED[name]))
        module.__dict__.update({k: v for k, v in present.items() if not k.startswith("__")})
        for former, now in RENAMED.items():
            where, _, attribute = former.rpartition(".")
            if where == name:
                there, _, renamed = now.rpartition(".")
                setattr(module, attribute, getattr(import_module(there), renamed))


def find_former_names() -> None:
    """Let modules be imported under their former names too."""
    if not any(isinstance(finder, _Former) for finder in sys.meta_path):
        sys.meta_path.append(_Former())
