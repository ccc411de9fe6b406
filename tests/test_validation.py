"""Unknown names and options: what the message says, and when it suggests another one."""

from __future__ import annotations

import numpy as np
import pytest

from pixelbrax_jax.validation import (
    check_bool,
    check_choice,
    check_count,
    check_finite,
    check_fraction,
    check_link,
    check_not_negative,
    check_options,
    check_positive,
    check_positive_int,
    suggest,
)

TASKS = ("ant", "halfcheetah", "inverted_double_pendulum", "inverted_pendulum", "walker2d")
OPTIONS = ("action_repeat", "frame_stack", "height", "num_envs", "obs_mode", "renderer", "width")


@pytest.mark.parametrize(
    ("given", "names", "nearest"),
    [
        ("Ant", TASKS, "ant"),
        ("cheetah", TASKS, "halfcheetah"),
        ("HalfCheeta", TASKS, "halfcheetah"),
        ("walker", TASKS, "walker2d"),
        ("double", TASKS, "inverted_double_pendulum"),
        ("pendulum", TASKS, None),
        ("2d", TASKS, None),
        ("mjs", ("generalized", "mjx"), "mjx"),
        (3, TASKS, None),
    ],
)
def test_suggestions(given, names, nearest):
    assert suggest(given, names) == (f" Did you mean {nearest!r}?" if nearest else "")


@pytest.mark.parametrize("given", ["render_mode", "autoreset_mode", "seed"])
def test_far_options_are_not_suggested(given):
    with pytest.raises(TypeError, match=r"allowed: .*, width\.$"):
        check_options([given], OPTIONS)


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        ("heigth", "height"),
        ("frame_skip", "action_repeat"),
        ("frameskip", "action_repeat"),
        ("n_envs", "num_envs"),
    ],
)
def test_options_that_were_meant(given, nearest):
    # The first words are Python's own, which TorchRL looks for.
    message = rf"^got an unexpected keyword argument '{given}'; allowed: .* mean '{nearest}'\?$"
    with pytest.raises(TypeError, match=message):
        check_options([given], OPTIONS)
    with pytest.raises(TypeError, match=r"allowed: look\.$"):
        check_options([given], ["look"])


@pytest.mark.parametrize("value", [True, False, np.True_])
def test_truth_values(value):
    assert check_bool("shadows", value) is bool(value)


@pytest.mark.parametrize("value", ["yes", "", 1, 0, None, np.ones(1, bool)])
def test_what_is_no_truth_value(value):
    with pytest.raises(TypeError, match="shadows must be True or False, got"):
        check_bool("shadows", value)


@pytest.mark.parametrize("value", [None, 3, ["spring"], {"a": 1}])
def test_what_is_no_name(value):
    with pytest.raises(ValueError, match=r"unknown backend: .*llowed: mjx, spring"):
        check_choice("backend", value, ["spring", "mjx"])


HUGE = 10**400
NUMBERS = {
    "positive integer": (check_positive_int, (1, np.int64(3), HUGE), (0, -2, 1.0, True, "1", None)),
    "whole number of at least 0": (check_count, (0, np.uint8(3)), (-1, 0.0, False, np.True_)),
    r"lie in \[0, 1\]": (check_fraction, (0, 1, np.float32(0.5)), (-0.1, 1.1, np.nan, True, "0")),
    "positive number": (check_positive, (3, 1e-9), (0, -1, np.inf, np.nan, HUGE, True, None)),
    "number of at least 0": (check_not_negative, (0, 0.0, 7), (-1e-9, np.inf, np.nan, (1,))),
    r"whole number of at least -1 \(none\)": (check_link, (-1, np.int32(2)), (-2, 0.0, True, None)),
    "finite number": (check_finite, (-3, np.float32(0)), (np.inf, -np.inf, np.nan, HUGE, "x")),
}


@pytest.mark.parametrize("wanted", NUMBERS)
def test_numbers(wanted):
    check, good, bad = NUMBERS[wanted]
    for value in good:
        assert check("lr", value) == value
        assert type(check("lr", value)) in (int, float)
    for value in bad:
        with pytest.raises(ValueError, match=rf"^lr must .*{wanted}, got "):
            check("lr", value)
