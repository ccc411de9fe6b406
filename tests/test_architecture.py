"""The import rules of CONTRIBUTING.md hold, and the checker of them sees a broken one."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGES = ("pixelbrax_jax", "pixelbrax_gym")

FOUNDATIONS = {
    "types",
    "spatial",
    "validation",
    "observations",
    "extras",
    "compilation",
    "flags",
    "memory",
    "stop_signals",
    "video",
    "ffmpeg",
    "cache",
    "paths",
    "processor",
}
LAYERS = {"physics", "scene", "renderer", "distractors"}
"""They never import each other; `envs` joins them."""


def _below(*names: str) -> set[str]:
    return {f"pixelbrax_jax.{name}" for name in FOUNDATIONS.union(names, {"_platform"})}


ALLOWED: dict[str, set[str]] = {
    **{f"pixelbrax_jax.{name}": set() for name in FOUNDATIONS},
    "pixelbrax_jax.spatial": {"pixelbrax_jax.types", "pixelbrax_jax.validation"},
    "pixelbrax_jax.observations": {"pixelbrax_jax.validation"},
    "pixelbrax_jax.compilation": {"pixelbrax_jax.flags", "pixelbrax_jax.validation"},
    "pixelbrax_jax.cache": {"pixelbrax_jax.paths"},
    "pixelbrax_jax.video": {
        "pixelbrax_jax.extras",
        "pixelbrax_jax.ffmpeg",
        "pixelbrax_jax.paths",
    },
    "pixelbrax_jax.policy": {"pixelbrax_jax.extras", "pixelbrax_jax.validation"},
    **{f"pixelbrax_jax.{name}": _below() for name in LAYERS},
    # The list of tasks, which loads no physics.
    "pixelbrax_jax.tasks": _below("physics"),
    "pixelbrax_jax.plain": _below("distractors"),
    "pixelbrax_jax.ranges": {"pixelbrax_jax.types", "pixelbrax_jax.validation"},
    "pixelbrax_jax.config": _below("plain", "ranges", *LAYERS),
    # What differs by device: it knows nothing of PixelBrax.
    "pixelbrax_jax._platform": {"pixelbrax_jax.flags"},
    "pixelbrax_jax.registry": _below("tasks", "physics"),
    "pixelbrax_jax.envs": _below("config", "ranges", "registry", *LAYERS),
    "pixelbrax_jax.generalisation": _below("config", "envs", "registry", *LAYERS),
    # The package itself, which names what is public.
    "pixelbrax_jax": _below("config", "envs", "registry", "policy", *LAYERS),
    "pixelbrax_jax.agents": {
        "pixelbrax_jax",
        *_below(
            "config",
            "envs",
            "generalisation",
            "policy",
            "ranges",
            "registry",
            "distractors",
        ),
    },
    "pixelbrax_gym": {
        "pixelbrax_jax",
        *_below("config", "generalisation", "plain", "registry", "tasks", "policy", "renderer"),
    }
    - {"pixelbrax_jax._platform"},
    # The command line joins everything, and nothing imports it.
    "pixelbrax_gym.cli": {
        "pixelbrax_gym",
        "pixelbrax_jax",
        *_below("config", "generalisation", "tasks", "policy", "physics", "distractors", "agents"),
    },
}
"""Package -> the packages that it may import besides itself."""

HOMES: dict[str, tuple[str, ...]] = {
    "brax": ("pixelbrax_jax/physics/brax/", "pixelbrax_jax/envs/brax_env.py"),
    "torch": (
        "pixelbrax_gym/interop/dlpack.py",
        "pixelbrax_gym/doctor.py",
        "pixelbrax_gym/policy.py",
        "pixelbrax_gym/torchrl/",
        "pixelbrax_gym/bench/adapters.py",
    ),
    # The models of our tasks are read as files.
    "dm_control": ("pixelbrax_jax/physics/dmc/suite.py",),
    "torchrl": ("pixelbrax_gym/torchrl/",),
    "tensordict": ("pixelbrax_gym/torchrl/",),
    "stable_baselines3": ("pixelbrax_gym/sb3/",),
    "pygame": ("pixelbrax_gym/gymnasium/window.py",),
}
"""Third party -> the only files and folders that may import it."""

_DISTRIBUTIONS = {
    "PIL": "pillow",
    "dm_control": "dm_control",
    "orbax": "orbax-checkpoint",
    "tensorboardX": "tensorboardx",
}
"""Import name -> what is installed, where the two differ."""

NO_NAMES = {"utils", "helpers", "common", "misc"}
MAX_LINES = 450


def modules_of(root: Path) -> dict[str, Path]:
    """Dotted names of all modules of the packages below ``root``."""
    return {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
    }


def imports_of(path: Path, modules: dict[str, Path]) -> Iterator[str]:
    """Dotted names that a file imports, wherever in it: at the top, in a function, by name."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                yield "." * node.level + (node.module or "")
                continue
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in modules else str(node.module)
        elif isinstance(node, ast.Call) and node.args:
            function = getattr(node.func, "attr", getattr(node.func, "id", None))
            argument = node.args[0]
            if function in ("import_module", "__import__") and isinstance(argument, ast.Constant):
                yield str(argument.value)


def package_of(module: str) -> str:
    """The package that a module belongs to: a folder or a file right below ``pixelbrax_jax``."""
    if module.startswith("pixelbrax_gym.cli"):
        return "pixelbrax_gym.cli"
    package, _, rest = module.partition(".")
    return f"{package}.{rest.split('.')[0]}" if package == "pixelbrax_jax" and rest else package


def violations(root: Path) -> list[str]:
    """One line for each broken rule in the packages below ``root``."""
    modules, broken = modules_of(root), []
    for module, path in modules.items():
        package, where = package_of(module), path.relative_to(root).as_posix()
        source = path.read_text("utf-8")
        if source.count("\n") > MAX_LINES:
            broken.append(f"{where}: more than {MAX_LINES} lines")
        if path.stem in NO_NAMES:
            broken.append(f"{where}: a module needs a name that says what is in it")
        public = not any(part.startswith("_") for part in module.split("."))
        if public and not ast.get_docstring(ast.parse(source)):
            broken.append(f"{where}: no docstring")
        for imported in imports_of(path, modules):
            if imported.startswith("."):
                broken.append(f"{where}: relative import {imported}")
            elif imported.split(".")[0] in PACKAGES:
                target = package_of(imported)
                if target != package and target not in ALLOWED.get(package, set()):
                    broken.append(f"{where}: {package} may not import {target}")
            elif not where.startswith(HOMES.get(imported.split(".")[0], ("",))):
                broken.append(f"{where}: may not import {imported}")
    return broken


def third_parties(root: Path) -> dict[str, set[str]]:
    """Third-party package -> the files that import it."""
    found: dict[str, set[str]] = {}
    modules = modules_of(root)
    for path in modules.values():
        for imported in imports_of(path, modules):
            top = imported.split(".")[0]
            if top not in sys.stdlib_module_names and top not in PACKAGES:
                found.setdefault(top, set()).add(path.relative_to(root).as_posix())
    return found


def cycles(root: Path) -> list[str]:
    """Modules that import each other, directly or by way of others; imports in functions count."""
    modules = modules_of(root)
    graph = {
        module: {imported for imported in imports_of(path, modules) if imported in modules}
        for module, path in modules.items()
        # They only name what is public, and load it when it is asked for.
        if module not in PACKAGES
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_packages_import_only_what_they_may():
    assert not violations(ROOT), "\n" + "\n".join(violations(ROOT))


def test_no_modules_import_each_other():
    assert cycles(ROOT) == []


def test_a_cycle_is_seen(tmp_path):
    write_tree(tmp_path, SOUND)
    assert cycles(tmp_path) == []
    write_tree(
        tmp_path,
        {
            "pixelbrax_jax/envs/vector.py": "from pixelbrax_jax.envs import autoreset\n",
            "pixelbrax_jax/envs/autoreset.py": "def f():\n    import pixelbrax_jax.envs.vector\n",
        },
    )
    assert set(cycles(tmp_path)) == {"pixelbrax_jax.envs.vector", "pixelbrax_jax.envs.autoreset"}


def test_every_package_has_a_rule():
    packages = {package_of(module) for module in modules_of(ROOT)}
    assert packages <= set(ALLOWED)


def test_every_third_party_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    core = {Requirement(line).name for line in project["dependencies"]}
    extras = {
        Requirement(line).name
        for name, lines in project["optional-dependencies"].items()
        if name not in ("dev", "docs")
        for line in lines
    }
    used = {_DISTRIBUTIONS.get(name, name.replace("_", "-")) for name in third_parties(ROOT)}
    # TorchRL pins the release of tensordict that goes with it.
    used -= {"tensordict"}
    # An extra of MuJoCo XLA brings the release of Warp that goes with it.
    used -= {"warp"}
    # Used only by who has it.
    used -= {"wandb", "mujoco-playground"}
    assert used <= core | extras, f"not declared: {used - core - extras}"
    # Imported as a part of mujoco.
    core -= {"mujoco-mjx"}
    assert core <= used, f"declared but not imported: {core - used}"


@pytest.mark.parametrize(
    ("package", "more"),
    [("pixelbrax_jax", set()), ("pixelbrax_gym", {"jax", "brax", "mujoco"})],
)
def test_importing_a_package_loads_nothing_heavy(package, more):
    heavy = {"torch", "stable_baselines3", "torchrl", "matplotlib", "pygame", "imageio"} | more
    code = f"import sys, {package}; print(sorted({heavy} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


SOUND = {
    "pixelbrax_jax/__init__.py": "from pixelbrax_jax.envs.pixel_env import step\n",
    "pixelbrax_jax/types.py": "import jax\n",
    "pixelbrax_jax/physics/brax/engine.py": "import brax.envs\nfrom pixelbrax_jax import types\n",
    "pixelbrax_jax/scene/place.py": "from pixelbrax_jax.types import Scene\n",
    "pixelbrax_jax/renderer/base.py": "from pixelbrax_jax import spatial, types\n",
    "pixelbrax_jax/spatial.py": "import jax\n",
    "pixelbrax_jax/envs/pixel_env.py": "from pixelbrax_jax.scene.place import place\n",
    "pixelbrax_gym/interop/dlpack.py": "import jax\nimport torch\n",
    "pixelbrax_gym/gymnasium/vector_env.py": "from pixelbrax_jax.types import Scene\n",
}


def write_tree(root: Path, files: dict[str, str]) -> None:
    for name, code in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(code if code.startswith('"""') else f'"""What it is for."""\n{code}')


def test_the_checker_passes_a_sound_tree(tmp_path):
    write_tree(tmp_path, SOUND)
    assert violations(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "code", "complaint"),
    [
        ("pixelbrax_jax/scene/place.py", "import pixelbrax_jax.physics.brax.engine", "physics"),
        ("pixelbrax_jax/scene/place.py", "from pixelbrax_jax.envs import pixel_env", "envs"),
        ("pixelbrax_jax/renderer/base.py", "from pixelbrax_jax.scene import place", "scene"),
        ("pixelbrax_jax/renderer/base.py", "def f():\n    import pixelbrax_jax", "pixelbrax_jax"),
        ("pixelbrax_jax/types.py", "from pixelbrax_jax import spatial", "spatial"),
        ("pixelbrax_jax/agents/a.py", "import pixelbrax_gym.cli.train", "may not import"),
        ("pixelbrax_gym/doctor.py", "from pixelbrax_gym.cli import main", "may not import"),
        ("pixelbrax_jax/envs/pixel_env.py", "import brax", "import brax"),
        ("pixelbrax_jax/envs/pixel_env.py", "from pixelbrax_gym import dlpack", "pixelbrax_gym"),
        ("pixelbrax_gym/gymnasium/vector_env.py", "from torch import nn", "import torch"),
        (
            "pixelbrax_gym/gymnasium/vector_env.py",
            "importlib.import_module('torch')",
            "import torch",
        ),
        (
            "pixelbrax_gym/gymnasium/vector_env.py",
            "from pixelbrax_jax.physics.brax import tasks",
            "physics",
        ),
        (
            "pixelbrax_gym/gymnasium/vector_env.py",
            "import pixelbrax_jax._platform.batches",
            "_platform",
        ),
        ("pixelbrax_jax/_platform/batches.py", "import pixelbrax_jax.types", "_platform may not"),
        ("pixelbrax_gym/gymnasium/vector_env.py", "from .dlpack import f", "relative"),
        ("pixelbrax_jax/scene/utils.py", "x = 1", "name"),
        ("pixelbrax_jax/scene/place.py", '""""""\nx = 1', "docstring"),
        ("pixelbrax_jax/scene/place.py", "x = 1\n" * (MAX_LINES + 1), "lines"),
        ("pixelbrax_jax/kitchen/sink.py", "import pixelbrax_jax.types", "kitchen may not"),
    ],
)
def test_the_checker_sees_a_violation(tmp_path, name, code, complaint):
    write_tree(tmp_path, {**SOUND, name: code})
    found = violations(tmp_path)
    assert len(found) == 1
    assert found[0].startswith(name)
    assert complaint in found[0]
