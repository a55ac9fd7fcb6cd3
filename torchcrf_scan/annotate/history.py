"""Undo and redo: the states of something that does not change, in the order in which they came."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

State = TypeVar("State")


@dataclass(frozen=True, slots=True)
class History(Generic[State]):
    """States before and after the present one. past: the last one last. future: the next one last."""

    present: State
    past: tuple[State, ...] = ()
    future: tuple[State, ...] = ()

    def do(self, state: State) -> History[State]:
        """A new present; what was undone is forgotten."""
        return History(state, (*self.past, self.present))

    def undo(self) -> History[State]:
        """One state back, if there is one."""
        return History(self.past[-1], self.past[:-1], (*self.future, self.present)) if self.past else self

    def redo(self) -> History[State]:
        """One state forth, if there is one."""
        return History(self.future[-1], (*self.past, self.present), self.future[:-1]) if self.future else self
