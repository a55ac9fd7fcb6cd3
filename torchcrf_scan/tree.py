"""Registration of dataclasses of tensors as containers of torch's transforms (pytrees)."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

from torch.utils._pytree import register_dataclass

Class = TypeVar("Class", bound=type)


def tensor_tree(cls: Class) -> Class:
    """Class decorator: `torch.export` and `torch.func` accept and return instances of the dataclass, also in saved programs.

    Not `torch.export.register_dataclass`, because of its field order: an exported program's `module()` inserts arguments into
    its checks by text replacement (torch 2.13), and `batch.source` is a prefix of `batch.source_mask`. So long names come first.
    """
    names = sorted((f.name for f in fields(cls)), key=len, reverse=True)
    register_dataclass(cls, field_names=names, serialized_type_name=f"{cls.__module__}.{cls.__qualname__}")
    return cls
