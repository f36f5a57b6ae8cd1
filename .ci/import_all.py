"""Imports every module of the installed packages; one that needs an extra at import fails."""

import importlib
import pkgutil

import psiu_adapters
import psiu_broker

count = 0
for package in (psiu_broker, psiu_adapters):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
            count += 1
print(f"{count} modules imported")
