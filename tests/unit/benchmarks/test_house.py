"""What counts as a public function without an Args section: only what a reader would look for one in."""

from __future__ import annotations

import ast

import pytest

from benchmarks.house import (
    GENERATED,
    PRODUCT,
    ROOT,
    functions,
    told_elsewhere,
    tracked,
    wants_args,
)

pytestmark = pytest.mark.slow

MODULE = '''
Json = Annotated[bool, typer.Option(help="As JSON.")]

def bare(a, b, c, d):
    """No section."""

def told(a, b, c, d):
    """With one.

    Args:
        a, b, c, d: the numbers.
    """

def referring(a, b, c, d):
    """The same in double precision: arguments of :func:`told`."""

def mentioning(a, b, c, d):
    """Says nothing of what is given, though it names :func:`told`."""

def command(client, name, out, json: Json):
    """Its options carry their help."""

@wp.kernel
def kernel(a, b, c, d):
    pass

@router.post("/things")
def route(a, b, c, d):
    pass

def few(a, b, c):
    pass

class Base:
    def push(self, a, b, c, d):
        """Add.

        Args:
            a, b, c, d: the numbers.
        """

    def pull(self, a, b, c, d):
        """Take."""

class Middle(Base):
    pass

class Derived(Middle):
    """One."""

    def __init__(self, a, b, c, d):
        pass

    def push(self, a, b, c, d):
        """Told by Base."""

    def pull(self, a, b, c, d):
        """Told by nobody."""

class Made:
    """Another.

    Args:
        a, b, c, d: the numbers.
    """

    def __init__(self, a, b, c, d):
        pass

class _Private:
    def push(self, a, b, c, d):
        pass
'''


@pytest.fixture(scope="module")
def wanting() -> set[str]:
    """Names of what is counted in ``MODULE``."""
    module = ast.parse(MODULE)
    told = told_elsewhere([module])
    return {
        f"{owner.name}.{function.name}" if owner else function.name
        for function, owner in functions(module)
        if wants_args(function, owner, told)
    }


def test_functions_that_tell_nothing_are_counted(wanting: set[str]) -> None:
    assert {"bare", "mentioning", "Base.pull", "Derived.__init__", "Derived.pull"} == wanting


def test_a_base_class_that_tells_nothing_covers_nothing() -> None:
    derived = ast.parse(
        "class Base:\n    def f(self): pass\nclass D(Base):\n    def f(self, a, b, c, d): pass"
    )
    told = told_elsewhere([derived])
    assert [function.name for function, owner in functions(derived) if wants_args(function, owner, told)] == [
        "f"
    ]


def test_every_public_function_of_the_product_with_four_parameters_has_a_section() -> None:
    texts = {path: (ROOT / path).read_text() for path in tracked(ROOT) if path.parts[0] in PRODUCT}
    modules = {path: ast.parse(text) for path, text in texts.items()}
    told = told_elsewhere(modules.values())
    bare = [
        f"{path}:{function.lineno} {function.name}"
        for path, module in modules.items()
        if not texts[path].startswith(GENERATED)
        for function, owner in functions(module)
        if wants_args(function, owner, told)
    ]
    assert len(modules) > 600 and bare == []
