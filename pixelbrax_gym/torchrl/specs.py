"""Build the TorchRL specs of a pixel environment."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.data.tensor_specs import TensorSpec, UnboundedDiscrete


class _Itself(type(Unbounded)):  # type: ignore[misc]
    # TorchRL's metaclass would replace the class of a new object by one of two that it knows.
    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return type.__call__(cls, *args, **kwargs)


class PixelSpec(UnboundedDiscrete, metaclass=_Itself):
    """Spec of images without tensors of bounds (``space`` is None).

    It equals an ordinary ``Unbounded`` of the same shape, dtype and device, whose bounds for 4096
    stacks of 84 x 84 frames take 26 s and gigabytes to build.
    """

    def __init__(
        self,
        shape: Any = (1,),
        device: Any = None,
        dtype: torch.dtype = torch.uint8,
        **kwargs: Any,
    ) -> None:
        kind = "continuous" if dtype.is_floating_point else "discrete"
        TensorSpec.__init__(
            self,
            shape=torch.Size(shape),
            space=None,
            device=torch.device("cpu" if device is None else device),
            dtype=dtype,
            domain=kwargs.pop("domain", kind),
            **kwargs,
        )
        self.encode = self._encode_eager

    def to(self, dest: Any) -> PixelSpec:
        """Return the spec with another dtype or on another device."""
        if dest is None:
            return self
        if isinstance(dest, torch.dtype):
            return PixelSpec(self.shape, self.device, dest)
        return PixelSpec(self.shape, dest, self.dtype)


def entries(obs: Any, images: tuple[str, ...]) -> dict[str, Any]:
    """Return the parts of an observation by TorchRL's names."""
    parts = obs if isinstance(obs, dict) else {(*images, "state")[0]: obs}
    return {"observation" if name == "state" else name: part for name, part in parts.items()}


def observation_spec(
    spec: Any, images: tuple[str, ...], num_envs: int, device: torch.device
) -> Composite:
    """Return the spec of an observation; names are those of ``entries``."""
    specs: dict[str, TensorSpec] = {}
    for name, part in entries(spec, images).items():
        shape, dtype = (num_envs, *part.shape), getattr(torch, part.dtype.name)
        if name != "observation":
            specs[name] = PixelSpec(shape, device, dtype)
        else:
            specs[name] = Unbounded(shape, device=device, dtype=dtype)
    return Composite(specs, shape=(num_envs,), device=device)


def done_spec(num_envs: int, device: torch.device) -> Composite:
    """Return the spec of ``done``, ``terminated`` and ``truncated``, each (N, 1) bool."""
    names = ("done", "terminated", "truncated")
    flags = {
        name: Categorical(2, shape=(num_envs, 1), device=device, dtype=torch.bool) for name in names
    }
    return Composite(flags, shape=(num_envs,), device=device)
