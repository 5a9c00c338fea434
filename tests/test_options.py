"""Every option is read: a field of a configuration class that no recipe looks at is a promise not kept."""

import ast
import re
from pathlib import Path

RECIPES = Path(__file__).parents[1] / "recipes"


def test_every_option_is_read():
    recipes = {file.stem: ast.parse(file.read_text()) for file in RECIPES.glob("*.py")}
    unread = unread_options(list(recipes.values()), schema=recipes["config"])
    assert not unread, "no recipe reads " + ", ".join(unread)


def test_an_unread_option_is_noticed():
    schema = ast.parse(
        "@dataclass\nclass Env:\n    name: str\n    size: int\n    seed: int\n"
        "@dataclass\nclass Other:\n    beta: float\n    eps: float\n"
        "@dataclass\nclass Root:\n    env: Env\n    other: Other\n    seed: int\n    out: str\n"
    )
    recipe = ast.parse(
        "def load() -> Root: ...\n"
        "def run(config: Root, point: Point):\n"
        "    env = config.env\n"
        "    point.size, point.out, config.seed\n"  # another's size; the seed of Root, not of Env
        "    config.out = 'changed'\n"  # written, not read
        "    adam(**asdict(config.other))\n"
        "    return [env.name for _ in range(3)]\n"
    )
    assert unread_options([recipe], schema) == ["Env.seed", "Env.size", "Root.out"]
    recipe.body += ast.parse("print(load().out, load().env.size)\nenv: Env | None = f()\nenv.seed").body
    assert unread_options([recipe], schema) == []


def unread_options(recipes: list[ast.Module], schema: ast.Module) -> list[str]:
    """Fields ("Class.field") of the dataclasses in `schema` that no recipe reads, by annotations."""
    classes = {node.name: node for node in schema.body if isinstance(node, ast.ClassDef)}
    fields = {name: fields_of(node) for name, node in classes.items()}
    parents = {name: [ast.unparse(base) for base in node.bases] for name, node in classes.items()}
    reads = OptionReads(fields, parents)
    for tree in recipes:
        reads.learn_functions(tree)
    for tree in recipes:
        reads.visit(tree)
    options = {(owner, name) for owner in fields for name in fields[owner]}
    return sorted(f"{owner}.{name}" for owner, name in options - reads.found)


def fields_of(node: ast.ClassDef) -> dict[str, ast.expr]:
    """Annotations of a dataclass by field."""
    annotated = [statement for statement in node.body if isinstance(statement, ast.AnnAssign)]
    return {field.target.id: field.annotation for field in annotated if isinstance(field.target, ast.Name)}


class OptionReads(ast.NodeVisitor):
    """Collects (class, field) for each `x.field` where annotations tell that x is a configuration."""

    def __init__(
        self, fields: dict[str, dict[str, ast.expr]], parents: dict[str, list[str]] | None = None
    ) -> None:
        self.fields, self.parents = fields, parents or {}
        self.returns: dict[str, str] = {}
        self.variables: dict[str, str] = {}
        self.found: set[tuple[str, str]] = set()

    def learn_functions(self, tree: ast.Module) -> None:
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and (kind := self.config_in(node.returns)):
                self.returns[node.name] = kind

    def config_in(self, annotation: ast.expr | None) -> str | None:
        """The configuration class that an annotation such as `config.DDPG | None` names."""
        names = re.findall(r"\w+", ast.unparse(annotation)) if annotation else []
        return next((name for name in names if name in self.fields), None)

    def declarer(self, owner: str, name: str) -> str:
        """The class that declares a field: the owner itself, or one that it inherits from."""
        inherited = [self.declarer(parent, name) for parent in self.parents.get(owner, [])]
        found = [kind for kind in [owner, *inherited] if name in self.fields.get(kind, {})]
        return found[0] if found else owner

    def type_of(self, node: ast.expr) -> str | None:
        if isinstance(node, ast.Name):
            return self.variables.get(node.id)
        if isinstance(node, ast.Attribute) and (owner := self.type_of(node.value)):
            return self.config_in(self.fields[self.declarer(owner, node.attr)].get(node.attr))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            return node.func.id if node.func.id in self.fields else self.returns.get(node.func.id)
        return None

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer = self.variables
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        own = {argument.arg: self.config_in(argument.annotation) for argument in arguments}
        self.variables = {name: kind for name, kind in (outer | own).items() if kind}
        self.generic_visit(node)
        self.variables = outer

    def visit_Assign(self, node: ast.Assign) -> None:
        self.generic_visit(node)
        for target in node.targets:
            if isinstance(target, ast.Name) and (kind := self.type_of(node.value)):
                self.variables[target.id] = kind

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.generic_visit(node)
        if isinstance(node.target, ast.Name) and (kind := self.config_in(node.annotation)):
            self.variables[node.target.id] = kind

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self.generic_visit(node)
        if isinstance(node.ctx, ast.Load) and (owner := self.type_of(node.value)):
            self.found.add((self.declarer(owner, node.attr), node.attr))

    def visit_keyword(self, node: ast.keyword) -> None:
        """`f(**asdict(x))` reads all of x."""
        self.generic_visit(node)
        call = node.value
        if node.arg is None and isinstance(call, ast.Call) and ast.unparse(call.func) in {"asdict", "vars"}:
            owner = self.type_of(call.args[0])
            self.found |= {(owner, name) for name in self.fields.get(owner or "", {})}
