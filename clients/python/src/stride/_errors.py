"""Errors of calls."""

from __future__ import annotations


class StrideError(Exception):
    """A call that the server refused, or that no server answered.

    Attributes:
        code: Code for programs, such as ``not-found``; ``away`` if no server answered.
        message: Description for users.
        hint: Remedy, if there is one.
        status: Status of HTTP; 0 if no server answered, 200 for a refusal of the registry.
    """

    def __init__(self, code: str, message: str, hint: str | None = None, status: int = 0) -> None:
        super().__init__(f"{message} ({code})" + (f"; {hint}" if hint else ""))
        self.code = code
        self.message = message
        self.hint = hint
        self.status = status
