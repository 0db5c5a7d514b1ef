"""Pages and drawings about runs and their evaluations."""

from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


@cache
def _templates() -> "Environment":
    from jinja2 import Environment, PackageLoader  # the import takes a while

    return Environment(loader=PackageLoader(__name__), autoescape=True, trim_blocks=True, lstrip_blocks=True)


def render(template: str, **values: Any) -> str:
    """Return a page or a drawing from a template in the folder templates/; texts are escaped. A page contains its style and
    its script. Its content security policy forbids the browser to load anything else.
    """
    return _templates().get_template(template).render(values)
