import importlib.metadata

import numpy as np

import bayesperiodic as bp


def printed(capsys):
    bp.show_versions()
    return dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())


def test_versions_are_those_of_the_installed_packages(capsys):
    found = printed(capsys)
    assert found["numpy"] == np.__version__
    assert found["bayesperiodic"] == importlib.metadata.version("bayesperiodic")
    assert {"python", "platform", "scipy", "numba", "emcee"} <= found.keys()


def test_missing_packages_are_marked(capsys, monkeypatch):
    def version(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert printed(capsys)["numpy"] == "-"
