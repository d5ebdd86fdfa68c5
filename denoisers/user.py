"""A user's own plug-in: ``file.py:Class``, a class that fits :class:`denoisers.Plugin`."""

import importlib.util
import inspect
import sys
from pathlib import Path

from denoisers.host import FEATURES, Plugin
from selfcorrect.errors import DenoiserError, FileError

__all__ = ["load"]


def load(path: str, class_name: str) -> Plugin:
    """Run a Python file and return an object of a class in it, made without arguments.

    What the file itself raises while it runs is not caught: its traceback is what its author needs.

    Raises:
        FileError: there is no such file.
        DenoiserError: the file is not Python, it has no such class, or the class is not a plug-in.
    """
    where = f"{path}:{class_name}"
    cls = _class(Path(path), class_name)
    if not callable(getattr(cls, "denoise", None)):
        raise DenoiserError(f"{where}: expected a method denoise(self, color, albedo, normal), but got none")
    try:
        inspect.signature(cls).bind()
    except TypeError as error:
        raise DenoiserError(f"{where}: expected a class that needs no arguments, but got: {error}") from error
    plugin: Plugin = cls()
    name = getattr(plugin, "name", None)
    if not isinstance(name, str):
        raise DenoiserError(f"{where}: expected an attribute name, a string, but got {name!r}")
    features = getattr(plugin, "features", None)
    if not isinstance(features, set | frozenset) or not features <= FEATURES:
        raise DenoiserError(
            f"{where}: expected an attribute features, a set of 'albedo' and 'normal', but got {features!r}"
        )
    multiple = getattr(plugin, "multiple", 1)
    if not isinstance(multiple, int) or multiple < 1:
        raise DenoiserError(f"{where}: expected an attribute multiple, an integer from 1, but got {multiple!r}")
    return plugin


def _class(path: Path, class_name: str) -> type:
    if not path.is_file():
        raise FileError(f"{path}: expected a Python file with the class {class_name}, but found no such file")
    name = f"denoisers.user:{path.resolve()}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise DenoiserError(f"{path}: expected a Python file, but got a file of another kind")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # as Python's documentation asks: dataclasses and pickle look there
    try:
        spec.loader.exec_module(module)
    except (SyntaxError, UnicodeDecodeError, ImportError) as error:
        raise DenoiserError(f"{path}: expected Python that can be imported, but got: {error}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        classes = inspect.getmembers(module, inspect.isclass)
        own = [key for key, cls in classes if cls.__module__ == name]
        raise DenoiserError(f"{path}: expected a class {class_name}, but got {', '.join(own) or 'no class'}")
    return found
