"""Names a user gives to components, variables, parameters and ports."""

from ..base.errors import ModelError

RESERVED = "()[]{}:/,;'\"`"  # what full names, derivatives "der(c.x)" and entries "c.r[0]" are written with


def check_name(name: object, what: str, where: str = "") -> None:
    """Raises a `ModelError` if a name cannot be used: full names are "component.name", "der(component.name)"."""
    if not isinstance(name, str) or not name or "." in name or any(c.isspace() for c in name):
        raise ModelError(f"{where}{_article(what)}'s name is a non-empty string without dots or spaces; got {name!r}")
    found = [c for c in name if c in RESERVED]
    if found or name.startswith("-"):
        character = found[0] if found else "-"
        raise ModelError(
            f"{where}{_article(what)}'s name cannot {'contain' if found else 'begin with'} {character!r}, which full "
            f"names such as 'der(c.x)' and 'c.r[0]' reserve; got {name!r}"
        )


def _article(what: str) -> str:
    return f"{'an' if what[0] in 'aeiou' else 'a'} {what}"
