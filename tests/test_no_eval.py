"""No line of the package runs what a file says: no eval, no pickle, no unsafe YAML, no shell."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
NEVER = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "torch.hub.load", "np.load", "numpy.load"}
NEVER |= {"yaml.unsafe_load", "yaml.full_load", "yaml.load_all", "shelve.open", "shutil.unpack_archive"}
READERS = {"pickle", "marshal", "dill", "cloudpickle", "joblib"}
SAFE_LOADERS = {"_ConfigLoader", "_ValueLoader", "SafeLoader", "BaseLoader"}
METHODS = {"extract", "extractall"}  # Of archives: nothing is unpacked to a disk


def dotted(node):
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def sins(source):
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        options = {word.arg: ast.unparse(word.value) for word in node.keywords}
        module, _, method = name.rpartition(".")
        loader = options.get("Loader", ast.unparse(node.args[1]) if len(node.args) > 1 else "")
        if (
            name in NEVER
            or (module in READERS and method in ("load", "loads", "Unpickler"))
            or (name == "torch.load" and options.get("weights_only") != "True")
            or (name == "yaml.load" and loader.rpartition(".")[2] not in SAFE_LOADERS)
            or options.get("shell", "False") != "False"
            or (isinstance(node.func, ast.Attribute) and node.func.attr in METHODS)
        ):
            yield f"line {node.lineno}: {ast.unparse(node)}"


def test_it_would_be_noticed():
    for source in (
        *("eval(text)", "exec(text)", "import os; os.system(text)", "pickle.loads(data)", "yaml.unsafe_load(text)"),
        *("torch.load(path)", "torch.load(path, weights_only=False)", "np.load(path, allow_pickle=True)"),
        *("yaml.load(text, Loader=yaml.Loader)", "yaml.load(text, yaml.FullLoader)"),
        *("subprocess.run(text, shell=True)", "zipfile.ZipFile(path).extractall(folder)"),
    ):
        assert list(sins(source)), source


def test_the_package_has_none_of_it():
    files = [*(ROOT / "sundae_ns").rglob("*.py"), *(ROOT / "method_configs").rglob("*.py")]
    assert len(files) > 100
    found = {str(path.relative_to(ROOT)): list(sins(path.read_text(encoding="utf-8"))) for path in files}
    assert {name: lines for name, lines in found.items() if lines} == {}
