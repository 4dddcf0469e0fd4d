"""Which folders of the repository the wheel carries, and under which names.

The folders keep their short names; installed, every one of them begins with ``physworld``, so that this distribution
takes no name in site-packages that another could want.
"""

from setuptools import find_packages, setup

IMPORT_NAMES = {
    "physworld": "physworld",
    "physworld_sample": "sample",
    "physworld_schemas": "schemas",
    "physworld_scenes": "scenes",
    "physworld_services": "services",
    "physworld_storage": "storage",
    "physworld_workers": "workers",
}

setup(
    package_dir=IMPORT_NAMES,
    packages=[
        package
        for name, folder in IMPORT_NAMES.items()
        for package in [name, *(f"{name}.{inner}" for inner in find_packages(folder))]
    ],
)
