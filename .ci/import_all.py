"""Imports every module of the installed packages; one that lacks its extra must say which."""

import importlib
import pkgutil

import psiu_adapters
import psiu_broker

count = 0
for package in (psiu_broker, psiu_adapters):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ImportError as error:
                if "psiu-broker[" not in str(error):
                    raise
                print(f"{module.name}: {error}")
            count += 1
print(f"{count} modules imported")
