"""Functions and classes by the name under which they can be imported, such as `jaxbeam.physics.tendon:at_nodes`."""

from __future__ import annotations

import importlib
import re
from types import ModuleType
from typing import Any

_IDENTIFIER = r"[^\W\d]\w*"
_NAME = re.compile(rf"{_IDENTIFIER}(\.{_IDENTIFIER})*:{_IDENTIFIER}(\.{_IDENTIFIER})*")
OWN = "jaxbeam"


def name_of(value: Any, where: str) -> str:
    """The name of a function or class, `module:qualified name`, by which it is found again.

    Args:
        value: the function or class.
        where: what it is in the scene, for the message.

    Raises:
        ValueError: if it cannot be imported: a lambda, a local function, or one of a script that is being run.
    """
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or not _NAME.fullmatch(f"{module}:{name}"):
        kind = "a lambda" if name and "<lambda>" in name else "a local function" if name else f"{value!r}"
        raise ValueError(
            f"{where}: expected a function or class that can be imported by its name, got {kind}; define it by def at "
            f"the top of a module"
        )
    if module == "__main__":
        raise ValueError(
            f"{where}: expected a function or class that can be imported, got {name} of the script that is run; move "
            f"it into a module of its own and import it from there"
        )
    if _found(module, name) is not value:
        raise ValueError(
            f"{where}: expected what {module} calls {name}, got something else of that name; define it by def at the "
            f"top of the module, under a name that nothing else takes"
        )
    return f"{module}:{name}"


def trusted_names(trust: Any) -> tuple[str, ...]:
    """Check names of modules that may be imported."""
    if not isinstance(trust, tuple | list) or not all(isinstance(each, str) for each in trust):
        raise ValueError(f'trust: expected a tuple of names of modules, such as ("my_module",), got {trust!r}')
    return tuple(trust)


def named(text: str, trust: tuple[str, ...]) -> Any:
    """The function or class of a name. Only modules of jaxbeam, and those in `trust`, are imported.

    Raises:
        ValueError: if its module is not trusted or cannot be imported, or nothing of that name is there.
    """
    if not _NAME.fullmatch(text):
        raise ValueError(f"path: the archive holds {text!r} where the name of a function is expected")
    module, name = text.split(":")
    if not any(module == each or module.startswith(f"{each}.") for each in (OWN, *trust)):
        raise ValueError(
            f"path: the archive needs {name} from the module {module}, which would be imported and run; if you trust "
            f'it, pass trust=("{module}",)'
        )
    try:
        value = _found(module, name)
    except ImportError as error:
        raise ValueError(
            f"path: the archive needs {name} from the module {module}, which cannot be imported ({error}); put it on "
            f"Python's path"
        ) from error
    # A name that a module has only imported, such as `os.system`, belongs to another module, which is not trusted.
    if (getattr(value, "__module__", None), getattr(value, "__qualname__", None)) != (module, name):
        raise ValueError(
            f"path: the archive needs {name} from the module {module}, which has nothing of that name now; use the "
            f"version that wrote it"
        )
    return value


def _found(module: str, name: str) -> Any:
    """What a module calls `name`, or None. Modules inside it are not entered."""
    value: Any = importlib.import_module(module)
    for part in name.split("."):
        value = getattr(value, part, None)
        if isinstance(value, ModuleType):
            return None
    return value
