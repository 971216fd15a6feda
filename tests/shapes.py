"""Shape checks by sample, a pytest plugin (`-p tests.shapes`): each function's first calls, then one call in many.

jaxtyping checks every call, which doubles what a heavy test costs, and prepares every function of a module while it is
imported. A wrong annotation shows in a function's first calls; what only rare calls do is asked now and then.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import jaxtyping

FIRST_CALLS = 20
THEN_ONE_IN = 101  # a prime: loops over a round number of sensors or frames are met at each of their turns

SAMPLED = "_checked_by_sample"

_check_always = jaxtyping.jaxtyped


def jaxtyped(target: Any = None, *, typechecker: Any) -> Any:
    """jaxtyping's decorator of the same name, as its import hook calls it: functions, their kinds, and dataclasses."""
    if target is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if inspect.isclass(target):
        init = target.__init__
        if dataclasses.is_dataclass(target) and not getattr(init, SAMPLED, False):
            target.__init__ = jaxtyped(init, typechecker=typechecker)
        return target
    if isinstance(target, (classmethod, staticmethod)):
        return type(target)(jaxtyped(target.__func__, typechecker=typechecker))
    if not inspect.isfunction(target):
        return _check_always(target, typechecker=typechecker)
    return _by_sample(target, typechecker)


def _by_sample(plain: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    """`plain`, whose first calls are checked, and one of many after them."""
    calls = 0
    checked: Callable[..., Any] | None = None

    @functools.wraps(plain)
    def sampled(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls, checked
        calls += 1
        if calls > FIRST_CALLS and calls % THEN_ONE_IN:
            return plain(*args, **kwargs)
        if checked is None:
            checked = _check_always(plain, typechecker=typechecker)
        return checked(*args, **kwargs)

    setattr(sampled, SAMPLED, True)
    return sampled


jaxtyping.jaxtyped = jaxtyped
