"""Gaps and distributions of gaps that cannot be read, or must not name a folder."""

_DEEP = 100_000 * "["
_TOML = [
    (_DEEP, "gap.toml: not valid TOML ("),
    ("a = " + _DEEP, "gap.toml: not valid TOML ("),
    ("effects = {", "gap.toml: not valid TOML ("),
    ("\0", "gap.toml: not valid TOML ("),
    ("# \udcff", "gap.toml: is no UTF-8 text (byte 2)"),
    ("effects = { latency = nan }", "gap.toml: not valid TOML (nan is no finite number)"),
    ("effects = { latency = inf }", "gap.toml: not valid TOML (inf is no finite number)"),
    ("effects = { latency = 1e999 }", "gap.toml: not valid TOML (1e999 is no finite number)"),
    ("effects = { latency = true }", "gap.toml: 'latency' must be a number or a list of numbers"),
    ("effects = { latency = 'x' }", "gap.toml: 'latency' must be a number or a list of numbers"),
    ("effects = { latency = [] }", "gap.toml: 'latency' must be a number or a list of numbers"),
    ("effects = { latency = {} }", "gap.toml: 'latency' must be a number or a list of numbers"),
    ("effects = { latency = 1979-05-27 }", "gap.toml: 'latency' must be a number or a list of numbers"),
    ("effects = 3", "gap.toml: 'effects' must be a table of names and numbers"),
    ("commands = 3", "gap.toml: 'commands' must be a table of names and numbers"),
    ("commands = { late = 4 }", "gap.toml: 'late' must be a whole number from 0 to 3, got 4"),
    ("commands = { latency = 1 }", "gap.toml: error of 'commands': there is no 'latency'"),
    ("params = []", "gap.toml: 'params' must be a table of names and numbers"),
    ("scene = 3", "gap.toml: 'scene' must be a name"),
    ("stratum = []", "gap.toml: 'stratum' must be a name"),
    ("families = 'x'", "gap.toml: 'families' must be a list of names"),
    ("families = [3]", "gap.toml: 'families' must be a list of names"),
    ("latency = 3", "gap.toml: unexpected 'latency'"),
    ("[effects]\nlatency = 1\nlatency = 2", "gap.toml: not valid TOML ("),
    ("['/tmp/x'.effects]", "gap.toml: the gap '/tmp/x' cannot name a folder"),
    ("['../../x'.effects]", "gap.toml: the gap '../../x' cannot name a folder"),
    ("['a/b'.effects]", "gap.toml: the gap 'a/b' cannot name a folder"),
    (r"['a\b'.effects]", r"gap.toml: the gap 'a\\b' cannot name a folder"),
    ("['.'.effects]", "gap.toml: the gap '.' cannot name a folder"),
    ("['..'.effects]", "gap.toml: the gap '..' cannot name a folder"),
    ("['.hidden'.effects]", "gap.toml: the gap '.hidden' cannot name a folder"),
    ("[''.effects]", "gap.toml: the gap '' cannot name a folder"),
    ("[' '.effects]", "gap.toml: the gap ' ' cannot name a folder"),
    (r'["a\u0000b".effects]', r"gap.toml: the gap 'a\x00b' cannot name a folder"),
    (r'["a\nb".effects]', r"gap.toml: the gap 'a\nb' cannot name a folder"),
    (r'["\u001b[31m".effects]', r"gap.toml: the gap '\x1b[31m' cannot name a folder"),
    (r'["a\u202eb".effects]', r"gap.toml: the gap 'a\u202eb' cannot name a folder"),
    ("['CON'.effects]", "gap.toml: the gap 'CON' cannot name a folder"),
    ("['nul.txt'.effects]", "gap.toml: the gap 'nul.txt' cannot name a folder"),
    (f"['{300 * 'x'}'.effects]", "gap.toml: the gap has 300 bytes: choose a shorter word"),
    (f"['{100 * 'ä'}x'.effects]", "gap.toml: the gap has 201 bytes: choose a shorter word"),
    ("['../x'.effects]\n['y'.effects]", "gap.toml: the gap '../x' cannot name a folder"),
]
_JSON = [
    ("", "gap.json: not valid JSON ("),
    (_DEEP, "gap.json: not valid JSON (nested too deeply)"),
    ("{", "gap.json: not valid JSON ("),
    ("[1]", "gap.json: unexpected 'list'"),
    ("null", "gap.json: unexpected 'NoneType'"),
    ('{"effects": {"latency": NaN}}', "gap.json: not valid JSON (NaN is no finite number)"),
    ('{"effects": {"latency": 1e999}}', "gap.json: not valid JSON (1e999 is no finite number)"),
    ('{"effects": {"latency": ' + 5_000 * "9" + "}}", "gap.json: not valid JSON ("),
    ('{"effects": {"latency": 1, "latency": 2}}', "gap.json: not valid JSON ('latency' stands there twice)"),
    ('{"../x": {"effects": {}}}', "gap.json: the gap '../x' cannot name a folder"),
    ('{"a": {"effects": {}}, "": {}}', "gap.json: the gap '' cannot name a folder"),
]
_DISTRIBUTIONS = [
    ("", "d.toml: has no family"),
    ("[a]", "d.toml: 'a' must be a table of items and their ranges"),
    ("[a]\nlatency = [2, 1]", "d.toml [a]: 'latency' needs a range [low, high]"),
    ("[a]\nnothing = [1, 2]", "d.toml [a]: 'nothing' is neither a parameter nor an effect of push"),
    ("[a]\nlatency = [0, 1]\ntogether = 3", "d.toml [a]: 'together' must be true or false"),
    ("[a]\nobs_bias = { nothing = [0, 1] }", "d.toml [a] obs_bias: there is no 'nothing'"),
]
_LONG = f"{240 * 'x'}.toml"

ROWS = [
    *[("evaluate --prior prior --real gap.toml", words, {"gap.toml": text}) for text, words in _TOML],
    *[("evaluate --prior prior --real gap.json", words, {"gap.json": text}) for text, words in _JSON],
    *[
        (f"{command} gap.toml", "the gap '../x' cannot name a folder", {"gap.toml": "['../x'.effects]"})
        for command in (
            "pretrain --real",
            "finetune --prior prior --real",
            "hybrid --method sac --task push --gap",
            "hybrid --method sac --task push --gap sim --real",
            "diagnose --prior prior --real",
            "gaps --presets",
            "compare --tasks push --reals",
            "studies.tune --tasks push --reals",
            "studies.factorial --reals",
            "studies.scoreboard --gaps",
            "collect --level 1 --task push --real",
            "compare hybrid --methods sac --reference sac --task push --gaps",
            "demo --real",
        )
    ],
    ("pretrain --real gap.toml", "gap.toml holds 2 gaps; name one of", {"gap.toml": "[a.effects]\n[b.effects]"}),
    ("evaluate --prior prior --real gap.toml:b", "there is no 'b'", {"gap.toml": "[a.effects]"}),
    ("evaluate --prior prior --real gap.toml:../x", "there is no '../x'", {"gap.toml": "[a.effects]"}),
    (f"evaluate --prior prior --real {_LONG}", "the name has 240 bytes", {_LONG: "effects = {}"}),
    ("evaluate --prior prior --real .toml", "the name '.toml' cannot name a folder", {".toml": "effects = {}"}),
    ("evaluate --prior prior --real fifo.toml", "fifo.toml: is no plain file"),
    ("evaluate --prior prior --real loop.toml", "loop.toml: cannot be read (too many levels of symbolic links)"),
    ("evaluate --prior prior --real folder.toml", "folder.toml: cannot be read (is a directory)"),
    ("studies.scoreboard --gaps gap.toml", "gap.toml [gap]: has no 'stratum'", {"gap.toml": "effects = {}"}),
]

HEAVY = [
    ("studies.gaps_draw --prior prior --count 3 --distribution d.toml", words, {"d.toml": text})
    for text, words in _DISTRIBUTIONS
]
