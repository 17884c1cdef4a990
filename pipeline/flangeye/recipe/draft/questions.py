"""Questions a folder leaves open: answered by an option, a person, or a stated default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from flangeye.errors import FlangeyeError, RecipeError

Prompt = Callable[[str, str | None], str]
"""Asks a person; takes the question and the default, returns the answer."""
Check = Callable[[str], object]
"""Raises :class:`FlangeyeError` for an answer that cannot be used."""


def one_of(*choices: str) -> Check:
    """Return a check that only ``choices`` pass."""

    def check(answer: str) -> None:
        if answer not in choices:
            raise RecipeError(f"{answer}: is none of {', '.join(choices)}")

    return check


@dataclass
class Questions:
    """Where answers come from.

    Attributes:
        given: Answers by flag, those asked for as well; None where it was not given.
        prompt: Asks a person, or None where there is nobody.
        assumed: What was taken by default, told at the end.
        likely: By option, an answer that the data show, and how they do.
    """

    given: dict[str, str | None] = field(default_factory=dict)
    prompt: Prompt | None = None
    assumed: list[str] = field(default_factory=list)
    likely: dict[str, tuple[str, str]] = field(default_factory=dict)

    def ask(
        self,
        flag: str,
        question: str,
        default: str | None,
        example: str = "",
        check: Check | None = None,
        known: str = "",
    ) -> str:
        """Return the answer to a question; a person whose answer is refused is asked again.

        Args:
            flag: The option that answers it.
            question: For people.
            default: What is likely; None where nothing is.
            example: An answer, for the message where there is none.
            check: Refuses an answer that is none.
            known: The answers there are, for whoever has to choose one.

        Raises:
            RecipeError: Nothing is likely, nobody can be asked; names the flag to add.
        """
        answer = self.given.get(flag)
        if answer is None:
            default, shown = self.likely.get(flag, (default, ""))
            if self.prompt is None and default is not None:
                reason = f"{shown}; " if shown else ""
                self.assumed.append(f"{question}: {default} ({reason}--{flag} says otherwise)")
                answer = default
            else:
                asked = f"{question} ({known})" if known else question
                answer = self._asked(flag, asked, default, example, check)
            self.given[flag] = answer
        return answer

    def _asked(
        self, flag: str, question: str, default: str | None, example: str, check: Check | None
    ) -> str:
        if self.prompt is None:
            raise RecipeError(f"{question}: nothing tells; add --{flag} {example}".rstrip())
        refused = ""
        while True:
            answer = self.prompt(f"{refused}{question} (--{flag})", default)
            try:
                if check:
                    check(answer)
            except FlangeyeError as error:
                refused = f"{error}\n"
            else:
                return answer
