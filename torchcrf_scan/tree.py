"""Dataclasses of tensors as torch's transforms see them: containers that they open (pytrees)."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

from torch.utils._pytree import register_dataclass

Class = TypeVar("Class", bound=type)


def tensor_tree(cls: Class) -> Class:
    """Class decorator: `torch.export` and `torch.func` take and return instances of the dataclass, and programs with it are saved.

    Not `torch.export.register_dataclass`, for its order of the fields: an exported program's `module()` puts arguments into its
    checks by replacing text (torch 2.13), and `batch.source` is a part of `batch.source_mask`. So long names come first.
    """
    names = sorted((f.name for f in fields(cls)), key=len, reverse=True)
    register_dataclass(cls, field_names=names, serialized_type_name=f"{cls.__module__}.{cls.__qualname__}")
    return cls
