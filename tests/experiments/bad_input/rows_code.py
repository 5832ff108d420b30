"""Tasks and methods of the user's own that cannot be used; each file is called `mine.py`."""

METHOD = """\
from dataclasses import dataclass
from sgft_jax.methods import sac
from sgft_jax.types import Method, Online
@dataclass(frozen=True)
class Config(sac.Config):
    pass
METHOD = Method("mine", Online("model-free", "mine", "here", Config, sac.build))
"""
_NO_METHOD = 'METHOD = Method("mine", Online("model-free", "mine", "here", Config, sac.build))\n'


def _method(line, before=""):
    return METHOD.replace(_NO_METHOD, before + line + "\n")


def _fixed(arguments):
    return f"""\
from sgft_jax.methods.options import ActorCriticOptions as Options
from sgft_jax.types import Fixed, Method
METHOD = Method("mine", fixed=Fixed({arguments}))
"""


_TASKS = [
    ("", "task mine.py: does not define `make`"),
    ("raise SystemExit", "task mine.py: line 1: SystemExit: no message"),
    ("import sys\nsys.exit(7)", "task mine.py: line 2: SystemExit: 7"),
    ("exit(0)", "task mine.py: line 1: SystemExit: 0"),
    ("1 / 0", "task mine.py: line 1: ZeroDivisionError: division by zero"),
    ("import nowhere", "task mine.py: line 1: ModuleNotFoundError: No module named 'nowhere'"),
    ("def make(:", "task mine.py: invalid syntax in line 1 of"),
    ("\0", "task mine.py: source code string cannot contain null bytes"),
    ("x = '\udcff'", "task mine.py: (unicode error)"),
    ("raise BaseException('odd')", "task mine.py: line 1: BaseException: odd"),
    ("raise GeneratorExit", "task mine.py: line 1: GeneratorExit"),
    ("def f(): f()\nf()", "task mine.py: line 1: RecursionError: maximum recursion depth exceeded"),
]

_METHODS = [
    ("", "method mine.py: does not define `METHOD`"),
    ("raise SystemExit", "method mine.py: line 1: SystemExit: no message"),
    ("import sys\nsys.exit(7)", "method mine.py: line 2: SystemExit: 7"),
    ("METHOD = 3", "method mine.py: line 1: METHOD is a int, not a sgft_jax.Method"),
    (_method("METHOD = Method(3, Online('sgft', 'a', 'b', Config, sac.build))"), "line 7: name is 3, not a text"),
    (
        _method("METHOD = Method('m', Online('odd', 'a', 'b', Config, sac.build))"),
        "line 7: family is 'odd'; choose from",
    ),
    (
        _method("METHOD = Method('m', Online(['sgft'], 'a', 'b', Config, sac.build))"),
        "line 7: family is ['sgft']; choose",
    ),
    (
        _method("METHOD = Method('m', Online('sgft', None, 'b', Config, sac.build))"),
        "line 7: description is None, not a text",
    ),
    (_method("METHOD = Method('m', Online('sgft', 'a', 4.5, Config, sac.build))"), "line 7: source is 4.5, not a text"),
    (
        _method("METHOD = Method('m', Online('sgft', 'a', 'b', int, sac.build))"),
        "line 7: config is <class 'int'>, not a data",
    ),
    (_method("METHOD = Method('m', Online('sgft', 'a', 'b', Config(), sac.build))"), "line 7: config is Config("),
    (
        _method("METHOD = Method('m', Online('sgft', 'a', 'b', Config, None))"),
        "line 7: build must be called as build(config",
    ),
    (
        _method("METHOD = Method('m', Online('sgft', 'a', 'b', Config, lambda config: 1))"),
        "line 7: build must be called as",
    ),
    (
        _method("METHOD = Method('m', Online('sgft', 'a', 'b', Config, sac.build, prior='x'))"),
        "line 7: prior is 'x'; choose",
    ),
    (
        _method("METHOD = Method('m', Online('sgft', 'a', 'b', Config, sac.build, 'sac', 'no'))"),
        "needs_prior is 'no', not",
    ),
    (
        _method("METHOD = Method('m', Online('sgft', 'a', 'b', Config, sac.build, zero_shot=None))"),
        "zero_shot is None, not",
    ),
    (_method("METHOD = Method('sac', Online('sgft', 'a', 'b', Config, sac.build))"), "line 7: the name 'sac' is taken"),
    (
        _method("METHOD = Method('../m', Online('sgft', 'a', 'b', Config, sac.build))"),
        "the name '../m' cannot name a folder",
    ),
    (
        _method("METHOD = Method('m\\nn', Online('sgft', 'a', 'b', Config, sac.build))"),
        r"the name 'm\nn' cannot name a folder",
    ),
    (_method("METHOD = Method('', Online('sgft', 'a', 'b', Config, sac.build))"), "the name '' cannot name a folder"),
    (_method("METHOD = Method(300 * 'm', Online('sgft', 'a', 'b', Config, sac.build))"), "the name has 300 bytes"),
    (METHOD.replace("    pass", "    must: int"), "method mine.py: line 4: TypeError: non-default argument 'must'"),
    (METHOD.replace("    pass", "    def __post_init__(self): 1 / 0"), "line 6: ZeroDivisionError: division by zero"),
    (METHOD.replace("(frozen=True)", ""), "method mine.py: line 4: TypeError: cannot inherit non-frozen dataclass"),
]

_FIXED = [
    (_method("METHOD = Method('m')"), "line 7: m has nothing for learning from a fixed set of data or a simulator"),
    (_method("METHOD = Method('m', fixed=3)"), "line 7: fixed is a int, not a sgft_jax.Fixed"),
    (_fixed("'odd', 'a', 'b', {'x': Options()}, print"), "line 3: kind is 'odd'; choose from hybrid, offline"),
    (_fixed("'offline', 'a', 'b', {}, print"), "line 3: presets is {}, not settings by name"),
    (_fixed("'offline', 'a', 'b', {'x': 3}, print"), "line 3: preset 'x' is 3, not an object of a dataclass"),
    (_fixed("'offline', 'a', 'b', {'x': Options()}, lambda config: 1"), "line 3: build must be called as build(conf"),
    (_fixed("'offline', 'a', 'b', {'x': Options()}, print, by_data=1"), "line 3: by_data is 1, not True or False"),
]

ROWS = [
    *[(f"{command} --task mine.py", words, {"mine.py": text}) for command in ("pretrain",) for text, words in _TASKS],
    *[("finetune --prior prior --method mine.py", words, {"mine.py": text}) for text, words in _METHODS],
    *[("hybrid --method mine.py", words, {"mine.py": text}) for text, words in _FIXED],
    ("tasks mine.py", "task mine.py: line 1: SystemExit: None", {"mine.py": "exit()"}),
    ("evaluate --prior prior --task mine.py", "task mine.py: line 1: SystemExit", {"mine.py": "exit()"}),
    ("hybrid --method sac --gap sim --task mine.py", "task mine.py: line 1: SystemExit", {"mine.py": "exit()"}),
    ("compare --methods mine.py", "method mine.py: line 1: SystemExit", {"mine.py": "exit()"}),
    ("pretrain --task nowhere.py", "task nowhere.py: No such file or directory"),
    ("pretrain --task folder.py", "task folder.py: is no plain file"),
    ("pretrain --task fifo.py", "task fifo.py: is no plain file"),
    ("pretrain --task loop.py", "task loop.py: is no plain file"),
    ("pretrain --task push.py", "task push.py: the name 'push' is taken", {"push.py": "def make(impl): pass"}),
    ("pretrain --task con.py", "task con.py: the name 'con' cannot name a folder", {"con.py": "def make(impl): pass"}),
    ("pretrain --task .py", "the name '.py' cannot name a folder", {".py": "def make(impl): pass"}),
    ("pretrain --task .", "task .: the name '' cannot name a folder"),
    ("pretrain --task ..", "task ..: the name '' cannot name a folder"),
    ("pretrain --task ../x", "task ../x: the name '/x' cannot name a folder"),
    ("pretrain --task a..b", "there is no module 'a'"),
    ("pretrain --task nowhere.at.all", "there is no module 'nowhere'"),
    ("pretrain --task os.path", "task os.path: does not define `make`"),
    ("finetune --method fifo.py", "method fifo.py: is no plain file"),
    ("finetune --method nowhere.py", "method nowhere.py: No such file or directory"),
]

_BUILDS = [
    ("    1 / 0", ": line 8: ZeroDivisionError: division by zero"),
    ("    exit(3)", ": line 8: SystemExit: 3"),
    ("    return None", ": build returns a NoneType, not a sgft_jax.Finetuner"),
]
_ALONE = "METHOD = Method('m', Online('sgft', 'a', 'b', Config, build, needs_prior=False))"

HEAVY = [
    (
        f"finetune --task own_task.py --prior none --real sim --seeds 1 --method mine_{i}.py",
        words,
        {f"mine_{i}.py": _method(_ALONE, f"def build(config, prior, task):\n{line}\n")},
    )
    for i, (line, words) in enumerate(_BUILDS)
]
