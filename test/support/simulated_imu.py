# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What an IMU on the camera of a simulated flight says."""

import numpy as np
from sph_stab_ros.simulation.flights import PAD_S
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.level import GRAVITY_M_S2

# Of the differences that derivatives are taken by.
STEP_S = 1e-3


def imu_samples(flight, R_camera_imu, rate_hz=200., force_noise_m_s2=0., rate_noise_rad_s=0.,
                force_bias_m_s2=(0, 0, 0), rate_bias_rad_s=(0, 0, 0), seed=0):
    """
    Return the ImuSamples of a flight, from a quarter of a second before its first frame on.

    ``R_camera_imu`` is how the IMU sits. Noise is white, its standard deviation that of one
    sample and axis; bias (3,) is constant, in the IMU's frame.
    """
    rng = np.random.default_rng(seed)
    t_s = np.arange(-PAD_S + STEP_S, flight.duration_s + PAD_S - STEP_S, 1 / rate_hz)
    R_before, R_now, R_after = (flight.R_mocap_camera(t_s + step) * R_camera_imu
                                for step in (-STEP_S, 0, STEP_S))
    rates_rad_s = (R_before.inv() * R_after).as_rotvec() / (2 * STEP_S)
    before, now, after = (flight.p_mocap_camera(t_s + step) for step in (-STEP_S, 0, STEP_S))
    accelerations_m_s2 = (before - 2 * now + after) / STEP_S**2
    forces_m_s2 = R_now.inv().apply(accelerations_m_s2 + (0, 0, GRAVITY_M_S2))
    stamps_ns = flight.stamps_ns[0] + np.rint(t_s * 1e9).astype(np.int64)
    return [ImuSample(int(stamp_ns), force, rate) for stamp_ns, force, rate in zip(
        stamps_ns,
        forces_m_s2 + force_bias_m_s2 + force_noise_m_s2 * rng.normal(size=forces_m_s2.shape),
        rates_rad_s + rate_bias_rad_s + rate_noise_rad_s * rng.normal(size=rates_rad_s.shape))]
