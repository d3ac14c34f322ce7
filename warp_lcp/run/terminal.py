"""Terminal output: escaped text, and no error if the terminal is gone."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Literal

import typer
from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook, RenderResult
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text
from typer.core import TyperGroup

from warp_lcp.files.size_limits import one_line, visible
from warp_lcp.run.kernel_cache import KernelCacheError

if TYPE_CHECKING:
    from typer._click.core import Context
    from typer._click.exceptions import ClickException

FREE_TEXT = "--set"  # its values may be arrays of several lines
# click's ClickException, which new versions of typer include.
UsageErrorBase: type[ClickException] = typer.BadParameter.__mro__[2]


class Terminal(Console):
    """Console that prints colors and bars but no control characters of its text."""

    def __init__(
        self,
        *,
        stderr: bool = False,
        quiet: bool = False,
        file: IO[str] | None = None,
        width: int | None = None,
        soft_wrap: bool = False,
        highlight: bool = True,
        force_terminal: bool | None = None,
        color_system: Literal["auto", "standard", "256", "truecolor"] | None = "auto",
    ) -> None:
        super().__init__(
            stderr=stderr,
            quiet=quiet,
            file=file,
            width=width,
            soft_wrap=soft_wrap,
            highlight=highlight,
            force_terminal=force_terminal,
            color_system=color_system,
        )
        self.push_render_hook(_EscapeHook())

    def on_broken_pipe(self) -> None:
        """Print no more after the reader has closed the pipe; the run continues."""
        self.quiet = True


class CommandGroup(TyperGroup):
    """Command group with the same error messages for wrong usage."""

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Raise an error for control characters in arguments."""
        for before, argument in zip(["", *args], args, strict=False):
            if (
                before != FREE_TEXT
                and not argument.startswith(f"{FREE_TEXT}=")
                and any(c < " " or c == "\x7f" for c in argument)
            ):
                raise typer.BadParameter(
                    f"{one_line(argument)}: holds control characters; choose another name", ctx
                )
        return super().parse_args(ctx, args)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: object,
    ) -> object:
        """Run a command; escape characters that the output's encoding lacks."""
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        return super().main(
            args, prog_name, complete_var, standalone_mode, windows_expand_args, **extra
        )

    def make_context(
        self, info_name: str | None, args: list[str], parent: Context | None = None, **extra: object
    ) -> Context:
        """Create a command's context; escape arguments in its errors."""
        try:
            return super().make_context(info_name, args, parent, **extra)
        except UsageErrorBase as error:
            error.message = visible(error.message)
            raise

    def invoke(self, ctx: Context) -> object:
        """Run a command; interruptions and cache errors end with exit code 1."""
        try:
            return super().invoke(ctx)
        except UsageErrorBase as error:
            error.message = visible(error.message)
            raise
        except (KernelCacheError, KeyboardInterrupt) as error:
            print_lines(
                error if isinstance(error, KernelCacheError) else "stopped: interrupted", error=True
            )
            raise typer.Exit(1) from error


def print_text(console: Console, text: str) -> None:
    """Print a text to a console, without markup; a closed terminal is no error."""
    with suppress(OSError):
        console.print(visible(text), markup=False, highlight=False, soft_wrap=True)


def print_lines(text: object, *, error: bool = False) -> None:
    """Print lines to the output or the error stream; a closed stream is no error."""
    with suppress(BrokenPipeError):
        typer.echo(visible(str(text)), err=error)


def table_lines(
    header: Iterable[str], rows: Iterable[Iterable[str]], *, left: Iterable[int] = (0,)
) -> str:
    """Return a table as text with aligned columns; `left` ones are left-aligned."""
    table = Table(
        *(Column(name, justify="left" if i in left else "right") for i, name in enumerate(header)),
        box=None,
        pad_edge=False,
    )
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    with (console := Console(width=1000)).capture() as text:
        console.print(table, highlight=False)
    return "\n".join(line.rstrip() for line in text.get().splitlines())


class _EscapeHook(RenderHook):
    """Render hook that escapes the text of a console."""

    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        """Return renderables whose text is visible."""
        return [_EscapedRenderable(renderable) for renderable in renderables]


class _EscapedRenderable:
    """Renderable with escaped text."""

    def __init__(self, renderable: ConsoleRenderable) -> None:
        self._renderable = renderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render with escaped control characters."""
        segments: Iterable[Segment] = console.render(self._renderable, options)
        for segment in segments:
            yield segment if segment.control else Segment(visible(segment.text), segment.style)
