"""Whether tensors can be handed to loops."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import debug_unwrap
from torch.nn import Parameter


def is_readable(*tensors: Tensor) -> bool:
    """Whether the values of tensors can be read now, on the CPU.

    They cannot in a compiled or exported program, inside a transform of `torch.func`, and where they are fake.
    """
    if torch.compiler.is_compiling():
        return False
    return all(of.device.type == "cpu" and type(of) in (Tensor, Parameter) for of in tensors) and not is_in_transform(*tensors)


def is_in_transform(*tensors: Tensor) -> bool:
    """Whether a transform of `torch.func` works on any of the tensors; not asked in a compiled program."""
    return not torch.compiler.is_compiling() and any(debug_unwrap(of) is not of for of in tensors)


def has_operators(tensor: Tensor) -> bool:
    """Whether the operators of `loops.chains` can take a tensor; exported programs are made of operators of torch alone."""
    return tensor.device.type == "cpu" and not torch.compiler.is_exporting()
