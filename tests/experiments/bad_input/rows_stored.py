"""What priors, runs, logs and released tables say of themselves, where it cannot be so."""

import json

_DEEP = 100_000 * "["


def _card(**changes):
    network = {"hidden": [8], "layer_norm": True, "actor_layer_norm": False, "activation": "relu"}
    sizes = {"obs_dim": 8, "act_dim": 2, "previous_actions": 2, "ensemble_size": 5, "gamma": 0.97}
    return json.dumps({"task": "push", "algorithm": "sac", "network": network, **sizes, **changes})


def _config(**changes):
    return json.dumps({"sgft_jax": "0", "format": 2, "kind": "finetune", "config": {"task": "push", **changes}})


_CARDS = [
    ("", "bad/prior.json: not valid JSON ("),
    ("{", "bad/prior.json: not valid JSON ("),
    (_DEEP, "bad/prior.json: not valid JSON (nested too deeply)"),
    ("\udcff", "bad/prior.json: is no UTF-8 text"),
    ("[1]", "bad/prior.json: is no JSON object"),
    ("null", "bad/prior.json: is no JSON object"),
    ("{}", "bad/prior.json: lacks task"),
    (_card(task=3), "bad/prior.json: task is a whole number, not a text"),
    (_card(task=None), "bad/prior.json: task is null, not a text"),
    (_card(task="nope"), "bad/prior.json: is of the task 'nope', which does not come with this code"),
    (_card(task="mine.py"), "bad/prior.json: is of the task 'mine.py', which does not come with this code"),
    (_card(task="/tmp/mine.py"), "bad/prior.json: is of the task '/tmp/mine.py'"),
    (_card(task="os.path"), "bad/prior.json: is of the task 'os.path'"),
    (_card(task="envs.franka.push"), "bad/prior.json: is of the task 'envs.franka.push'"),
    (_card(task="../x"), "bad/prior.json: is of the task '../x'"),
]
_READ_CARDS = ("evaluate --prior bad", "export --policy bad --to numpy", "diagnose --prior bad")

_CONFIGS = [
    ("{", "bad/config.json: not valid JSON ("),
    (_DEEP, "bad/config.json: not valid JSON (nested too deeply)"),
    ("[1]", "bad/config.json: is no JSON object"),
    ("{}", "bad/config.json: lacks config"),
    ('{"config": 3}', "bad/config.json: config is a whole number, not an object"),
    (_config(task=3), "bad/config.json: config.task is a whole number, not a text"),
    (_config(seed="0"), "bad/config.json: config.seed is a text, not a whole number"),
    (_config(seed=-1), "bad/config.json: config.seed: "),
    (_config(seed=0.5), "bad/config.json: config.seed is a number, not a whole number"),
    (_config(task="nope"), "bad/config.json: is of the task 'nope', which does not come with this code"),
    (_config(task="mine.py"), "bad/config.json: is of the task 'mine.py', which does not come with this code"),
    (_config(task="os.path"), "bad/config.json: is of the task 'os.path'"),
]
_READ_CONFIGS = ("replay --run bad", "export_data --run bad --to minari --out x-v0", "diagnose --real bad")
_ROLLOUT = {"bad/real/rollout-000000.npz": ""}

_LINES = [
    ("{}\n", "eval.jsonl:1: lacks step"),
    ("[1]\n", "eval.jsonl:1: is no JSON object"),
    ("{\n", "eval.jsonl:1: not valid JSON ("),
    (_DEEP + "\n", "eval.jsonl:1: not valid JSON (nested too deeply)"),
    ('{"step": 0, "success": [0.0]}\n', "eval.jsonl:1: lacks rollouts"),
    ('{"step": 0, "rollouts": 0, "robot_minutes": 0, "success": ["x"]}\n', "eval.jsonl:1: success[0] is a text"),
    ('{"step": 0, "rollouts": 0, "robot_minutes": 0, "success": null}\n', "eval.jsonl:1: success is null"),
    (
        '{"step": 0, "rollouts": 0, "robot_minutes": 0, "success": [0]}\n{"success": [0, 1]}\n',
        "eval.jsonl:2: lacks step",
    ),
]
_HEAD = "task,gap,method,variant,priors,prior,seed,rollouts,transitions,minutes,success,return,training\n"
_TABLES = [
    ("", "hold no run"),
    ("task,gap\npush,hard\n", "curves-push.csv: row 1 has no method; put the table back"),
    (_HEAD + "push,hard,sac,,robust,0,0,0,0,0,1,2,\npush,hard,sac,,robust,0\n", "row 2 has no seed"),
    (_HEAD + "push,hard,sac,,robust,0,0,none,0,0,1,2,\n", "'none'; put the tables back"),
    (_HEAD + "push,hard,sac,,robust,0,0,0,0,0,1,nan,\n\udcff\n", "curves-push.csv: is no UTF-8 text"),
    (_HEAD + "push,hard,sac,,robust,0,0,0,0,0,,,\n", "has no success or return"),
    (_HEAD + "push,hard,sac,,robust,0,0,0,0,0,nan,2,\n", "success is nan, not a finite number"),
    (_HEAD + "push,hard,sac,,robust,0,0,inf,0,0,1,2,\n", "rollouts is inf, not a finite number"),
    (_HEAD + "push,../../x,sac,,robust,0,0,0,0,0,1,2,\n", "the gap '../../x' cannot name a folder"),
    (_HEAD + "../push,hard,sac,,robust,0,0,0,0,0,1,2,\n", "the task '../push' cannot name a folder"),
]
_OWN = "finetune/push/default/sac/seed"

ROWS = [
    *[(command, words, {"bad/prior.json": text}) for command in _READ_CARDS for text, words in _CARDS],
    *[(command, words, {"bad/config.json": text, **_ROLLOUT}) for command in _READ_CONFIGS for text, words in _CONFIGS],
    ("finetune --prior bad", "prior.json: task is null, not a text", {"bad/prior.json": _card(task=None)}),
    ("finetune --prior bad", "algorithm is null, not a text", {"bad/prior.json": _card(algorithm=None)}),
    ("finetune --prior bad", "algorithm='losses', which this", {"bad/prior.json": _card(algorithm="losses")}),
    ("finetune --prior bad", "system[0] is a list, not an object", {"bad/prior.json": _card(system=[[1]])}),
    ("collect --policy bad --task push", "bad/prior.json: lacks task", {"bad/prior.json": "{}"}),
    ("studies.bullet --prior bad", "bad/prior.json: lacks task", {"bad/prior.json": "{}"}),
    ("real_demo --prior bad", "bad/prior.json: lacks task", {"bad/prior.json": "{}"}),
    ("gaps --prior bad", "bad/prior.json: lacks task", {"bad/prior.json": "{}"}),
    ("benchmark --parts system --prior bad", "bad/prior.json: lacks task", {"bad/prior.json": "{}"}),
    ("finetune --tuned", "guarded.json: is no JSON object", {"runs/tuned/push/guarded.json": "[1]"}),
    ("finetune --tuned", "not valid JSON", {"runs/tuned/push/guarded.json": _DEEP}),
    (
        "finetune --tuned",
        "there is no option 'x'",
        {"runs/tuned/push/guarded.json": '{"budget": {}, "options": {"x": 1}}'},
    ),
    (
        "finetune --tuned",
        "guarded.json: utd is a text, not a number; tune again",
        {"runs/tuned/push/guarded.json": '{"budget": {}, "options": {"utd": "x"}}'},
    ),
    (
        "finetune --tuned",
        "options is a whole number, not an object",
        {"runs/tuned/push/guarded.json": '{"budget": {}, "options": 3}'},
    ),
    (
        "compare --tasks push --methods sac --dry",
        "not valid JSON",
        {f"runs/{_OWN}s-0-9/config.json": "{", f"runs/{_OWN}s-0-9/summary.json": "{"},
    ),
]

HEAVY = [
    *[("figures --out bad", words, {f"bad/{_OWN}-0/eval.jsonl": text}) for text, words in _LINES],
    *[("figures --data bad --out bad", words, {"bad/curves-push.csv": text}) for text, words in _TABLES],
]
