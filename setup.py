# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from glob import glob

from setuptools import Extension, find_packages, setup

package_name = 'sph_stab_ros'

# Wheels of ROS 2 Jazzy exist for x86-64 Linux only; elsewhere rclpy comes from the distribution.
x86_64_linux = 'sys_platform == "linux" and platform_machine == "x86_64"'

setup(
    name=package_name,
    version='0.1.0',
    description='Rotational stabilisation of 360-degree video by dense optical flow',
    author='The sph_stab_ros developers',
    author_email='sph_stab_ros@users.noreply.github.com',
    maintainer='The sph_stab_ros developers',
    maintainer_email='sph_stab_ros@users.noreply.github.com',
    license='Apache-2.0',
    packages=find_packages(include=[package_name, package_name + '.*']),
    package_data={package_name: ['py.typed'], package_name + '.operator': ['page/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.*')),
        ('share/' + package_name + '/launch', glob('launch/*.launch.py')),
    ],
    # Where it cannot be built the same is done in NumPy.
    ext_modules=[Extension(
        package_name + '.kernels._kernels', [package_name + '/kernels/kernels.c'],
        extra_compile_args=['-O3', '-ffast-math'], libraries=['m'], optional=True)],
    zip_safe=False,
    python_requires='>=3.10',
    # Lower bounds: what Jazzy's platform, Ubuntu 24.04, ships, or the oldest that works.
    install_requires=[
        'backports.zstd>=1.0.0,<2; python_version < "3.14"',
        'lz4>=4.4.0,<5',
        'numpy>=1.26.4,<3',
        'opencv-python-headless>=4.6.0.66,<5',
        'rosbags>=0.11.9,<0.12',
        'ruamel.yaml>=0.17.21,<1',
        'scipy>=1.11.4,<2',
        'threadpoolctl>=3.1.0,<4',
        'tqdm>=4.66.2,<5',
    ],
    extras_require={
        'cluster': ['distributed>=2024.8.0,<2027'],
        # Video over a radio that loses packets. pyOpenSSL is aioquic's: so the oldest go together.
        'datagrams': ['aioquic>=0.9.25,<2', 'pyopenssl>=23.3.0'],
        'operator': ['aiohttp>=3.9.1,<4', 'cryptography>=41.0.7,<51'],
        'plots': ['matplotlib>=3.8.0,<4'],
        # What others' methods make of the same pictures, for the benchmark alone.
        'references': ['poselib>=2.0.5,<3', 'pycolmap>=4.1.0,<5'],
        # The first whose decoder of H.265 says where a picture that it needs is missing.
        'video': ['av>=16.0.0,<19'],
        'ros': [
            'ros-jazzy-rclpy[fastrtps]>=7.1,<8; ' + x86_64_linux,
            'ros-jazzy-common-interfaces>=5.3,<6; ' + x86_64_linux,
        ],
        'test': [
            'pytest>=7.4.4,<9',
            # Laws on random sequences.
            'hypothesis>=6.98.15,<7',
            # For rooms and types (see pyproject.toml); the newest that run on 3.10.
            'import-linter>=2.1,<2.6',
            'mypy>=1.15,<1.19',
            # Drives the browser that is there; none of its own.
            'playwright>=1.60,<2',
            'pytest-cov>=7.1,<8',
            # CI tries what fails once more.
            'pytest-rerunfailures>=16.1,<17',
            # Runs what only computes beside what waits for processes: half the time on two cores.
            'pytest-xdist>=3.6.1,<4',
            # Jazzy's linters with the flake8 and plugins of its platform, for the same rules.
            'ros-ament-flake8==0.17.*',
            'ros-ament-pep257==0.17.*',
            'flake8==7.0.0',
            'flake8-blind-except==0.2.1',
            'flake8-builtins==2.1.0',
            'flake8-class-newline==1.6.0',
            'flake8-comprehensions==3.14.0',
            'flake8-deprecated==2.2.1',
            'flake8-docstrings==1.7.0',
            'flake8-import-order==0.18.2',
            'flake8-quotes==3.4.0',
            'pydocstyle==6.3.0',
            # colcon as on Jazzy: its templates need empy 3, --symlink-install an old setuptools.
            'colcon-core>=0.21.3,<1',
            'colcon-python-setup-py>=0.2.9,<1',
            'colcon-recursive-crawl>=0.2.3,<1',
            'colcon-ros>=0.5.0,<1',
            'empy==3.3.4',
            'setuptools==68.*',
            'wheel>=0.42,<1',
        ],
    },
    entry_points={
        'console_scripts': [
            'batch = sph_stab_ros.executable:batch',
            'benchmark = sph_stab_ros.executable:benchmark',
            'calibrate = sph_stab_ros.executable:calibrate',
            'camera = sph_stab_ros.executable:camera',
            'demo = sph_stab_ros.executable:demo',
            'evaluate = sph_stab_ros.executable:evaluate',
            'operator = sph_stab_ros.executable:operator',
            'player = sph_stab_ros.executable:player',
            'replay = sph_stab_ros.executable:replay',
            'sph-stab = sph_stab_ros.__main__:main',
            'stabilizer = sph_stab_ros.executable:stabilizer',
        ],
    },
)
