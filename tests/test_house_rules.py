"""Planted offences: each rule of the house catches what it is there for."""

import ast

import pytest
from house_rules import MAX_FILE_LINES, MAX_FUNCTION_LINES, global_randomness, too_long, unwanted, wrong_imports


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cadence/a.py", "import pipeline.windows"),
        ("cadence/a.py", "from schemas.tables import TRUTH"),
        ("schemas/a.py", "import cadence.types"),
        ("pipeline/a.py", "import cli"),
        ("cli.py", "import cadence.types"),
        ("cli.py", "from schemas import tables"),
        ("pipeline/a.py", "import pickle"),
        ("pipeline/a.py", "def f():\n    from mcap_codec_support import ros"),
        ("cadence/a.py", "import os.path"),
        ("cadence/a.py", "if TYPE_CHECKING:\n    from pathlib import Path"),
    ],
)
def test_planted_imports_are_caught(name, text):
    assert len(wrong_imports(name, ast.parse(text))) == 1


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("pipeline/utils.py", ""),
        ("pipeline/a.py", "print(1)"),
        ("pipeline/a.py", "x = eval('1')"),
        ("pipeline/a.py", "try:\n    f()\nexcept:\n    raise"),
        ("pipeline/a.py", "try:\n    f()\nexcept Exception:\n    pass"),
        ("pipeline/a.py", "def f():\n    global x\n    x = 1"),
        ("cadence/network/a.py", "from torch import nn\nlayer = nn.LSTM(3, 4)"),
        ("cadence/network/a.py", "from torch.nn import GRUCell\nlayer = GRUCell(3, 4)"),
    ],
)
def test_planted_words_are_caught(name, text):
    assert unwanted(name, ast.parse(text))


@pytest.mark.parametrize(
    "text",
    [
        "import torch\ntorch.manual_seed(0)",
        "import torch\ntorch.random.manual_seed(0)",
        "import torch\ntorch.default_generator.manual_seed(0)",
        "import torch\ntorch.cuda.manual_seed_all(0)",
        "import torch\ntorch.random.set_rng_state(state)",
        "from torch import manual_seed\nmanual_seed(0)",
        "from torch.random import manual_seed as sow\nsow(0)",
        "import torch\nwith open(path):\n    torch.random.manual_seed(0)",
        "import torch\nx = torch.randn(3)",
        "import torch\nx = torch.randn_like(y)",
        "import torch as t\nx = t.rand(3)",
        "import torch\nx = torch.empty(3).normal_()",
        "import numpy as np\nnp.random.seed(0)",
        "import numpy\nx = numpy.random.randn(3)",
        "from numpy import random\nx = random.gamma(1.0)",
        "from numpy.random import shuffle\nshuffle(x)",
        "import random\nrandom.sample(x, 3)",
        "import random as dice\ndice.random()",
        "from random import shuffle\nshuffle(x)",
    ],
)
def test_planted_randomness_is_caught(text):
    assert len(global_randomness("cadence/a.py", ast.parse(text))) == 1


@pytest.mark.parametrize(
    "text",
    [
        "import torch\ng = torch.Generator().manual_seed(0)\nx = torch.randn(3, generator=g)\ny = x.normal_(generator=g)",
        "import torch\nwith torch.random.fork_rng(devices=[]):\n    torch.random.manual_seed(0)\n    build()",
        "import numpy as np\nrng = np.random.default_rng(0)\nx = rng.normal(size=3) + rng.choice(3)",
        "import random\nmoment = random.Random(7)\nx = moment.uniform(0.0, 1.0)",
        "from torch import nn\nnn.init.normal_(weight)",
    ],
)
def test_generators_of_ones_own_are_let_through(text):
    assert not global_randomness("cadence/a.py", ast.parse(text))


def test_planted_lengths_are_caught():
    body = "    x = 1\n"
    assert not too_long("cadence/a.py", "def f():\n" + (MAX_FUNCTION_LINES - 1) * body)
    assert too_long("cadence/a.py", "def f():\n" + MAX_FUNCTION_LINES * body) == [
        f"cadence/a.py::f: {MAX_FUNCTION_LINES + 1} lines: split it, or give the reason"
    ]
    assert not too_long("cadence/a.py", MAX_FILE_LINES * "x = 1\n")
    assert len(too_long("cadence/a.py", (MAX_FILE_LINES + 1) * "x = 1\n")) == 1
