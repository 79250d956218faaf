"""Pixels over several devices and processes give what one device gives."""

import os
import subprocess
import sys
from pathlib import Path


def test_on_eight_devices():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    tests = Path(__file__).with_name("forced_devices.py")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
    run = subprocess.run(
        [*command, str(tests)],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout
