#!/usr/bin/env bash
# Expected: a reliable writer and a reliable reader that is there from the start: the reader takes all samples written.
# Happens: only the last one. The Python binding's default history has a depth of one, and reliability covers what is in
# the history; write() returns without an error. Policy.History.KeepAll, on both sides, gives all of them.
# Seen with: cyclonedds 11.0.1; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    cyclonedds==11.0.1
env/bin/python - <<'PY'
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Torque(IdlStruct):
    number: int


participant = DomainParticipant(71)


def taken(name, *policies):
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), *policies)
    topic = Topic(participant, name, Torque, qos=qos)
    reader, writer = DataReader(participant, topic, qos=qos), DataWriter(participant, topic, qos=qos)
    for number in range(50):
        writer.write(Torque(number))
    return [sample.number for sample in reader.take(100)]


default, all_kept = taken("default"), taken("all_kept", Policy.History.KeepAll)
print("reliable:", default)
print("reliable, KeepAll:", len(all_kept), "samples")
assert default == [49]
assert all_kept == list(range(50))
PY
