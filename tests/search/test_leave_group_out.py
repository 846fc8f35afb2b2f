"""A fold's readings are a part of the record: what is left out says nothing, and its time still passes."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal._calibration.part import Part
from bayescal._inference.density import Density
from bayescal._inference.noise_on_record import whitening
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.noise_terms import CORRELATION_TIME, DIFFUSION
from bayescal._model.parameters import bind
from bayescal_models import still_sensor
from tests.support.inside import frame_of

VALUES = {"noise.white": 20.0, DIFFUSION: 1.5, CORRELATION_TIME: 300.0}


@pytest.fixture(scope="module")
def whole() -> Problem:
    readings = still_sensor.simulate({}, seed=3, interval=120)
    noise = bc.OrnsteinUhlenbeck(10.0, 1e4)
    model = still_sensor.instrument("ug").baseline().with_noise(noise)
    frame = frame_of(readings)
    record = Record(model.instrument, frame, np.asarray(readings["output"]))
    return Problem(bind(model, readings)[0], record)


def test_wandering_noise_skips_what_is_left_out(whole, rng) -> None:
    record = whole.record
    rows = np.sort(rng.permutation(record.size)[: record.size // 2])
    white = whitening(whole.noise, VALUES, Part(record, rows), 0.0)
    table, log_volume = white.both(np.eye(len(rows)))
    time, run = np.asarray(record.frame["time"])[rows], record.codes["run"][rows]
    apart = np.abs(time[:, None] - time)
    size = 0.5 * VALUES[DIFFUSION] ** 2 * VALUES[CORRELATION_TIME]
    dense = size * np.exp(-apart / VALUES[CORRELATION_TIME]) * (run[:, None] == run)
    dense += VALUES["noise.white"] ** 2 * np.eye(len(rows))
    np.testing.assert_allclose(table.T @ table, np.linalg.inv(dense), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(log_volume, np.linalg.slogdet(dense)[1])


def test_a_part_with_all_readings_is_the_whole(whole) -> None:
    flat, v = np.ones(whole.size), np.zeros(len(whole.hypers))
    part = Problem(whole.layout, Part(whole.record, np.arange(whole.record.size)))
    both = [Density(a, whole.start, flat).at(v)[0] for a in (whole, part)]
    assert both[0] == both[1]
