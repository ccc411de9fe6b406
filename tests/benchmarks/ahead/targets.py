"""Accelerators that programs are compiled for, as XLA wants them described."""

from __future__ import annotations

from dataclasses import dataclass

LAUNCH_SECONDS = 1.5e-6
"""What the model of time takes for a kernel within a CUDA graph, however little it does."""


@dataclass(frozen=True)
class Card:
    """An NVIDIA GPU; figures are those of its data sheet and of CUDA's tables of capabilities."""

    kind: str  # as its driver names it
    capability: tuple[int, int]
    cores: int  # streaming multiprocessors
    fp32_per_core: int
    bandwidth: int  # bytes per second
    memory: int  # bytes, as what follows
    l2: int
    shared_per_core: int
    shared_per_block: int
    clock: float  # GHz

    @property
    def architecture(self) -> str:
        """As ``ptxas`` names it; Hopper's own instructions need the suffix."""
        major, minor = self.capability
        return f"sm_{major}{minor}{'a' if major == 9 else ''}"

    def target_config(self) -> str:
        """Return XLA's ``GpuTargetConfigProto`` of the card as text."""
        major, minor = self.capability
        feature = "feature_extension: ACCELERATED_FEATURES" if major == 9 else ""
        return f"""
            gpu_device_info {{
              threads_per_block_limit: 1024
              threads_per_warp: 32
              shared_memory_per_block: 49152
              shared_memory_per_core: {self.shared_per_core}
              shared_memory_per_block_optin: {self.shared_per_block}
              threads_per_core_limit: 2048
              core_count: {self.cores}
              fpus_per_core: {self.fp32_per_core}
              block_dim_limit_x: 2147483647
              block_dim_limit_y: 65535
              block_dim_limit_z: 65535
              thread_dim_limit_x: 1024
              thread_dim_limit_y: 1024
              thread_dim_limit_z: 64
              registers_per_core_limit: 65536
              registers_per_block_limit: 65536
              memory_bandwidth: {self.bandwidth}
              l2_cache_size: {self.l2}
              clock_rate_ghz: {self.clock}
              device_memory_size: {self.memory}
              device_address_bits: 64
              cuda_compute_capability {{ major: {major} minor: {minor} {feature} }}
              name: "{self.kind}"
              device_vendor: "NVIDIA Corporation"
              driver_version: "12.8.0"
              runtime_version: "12.8.0"
              compile_time_toolkit_version: "12.8.0"
              dnn_version: "9.10.0"
            }}
            platform_name: "CUDA"
            runtime_version {{ major: 12 minor: 8 patch: 0 }}
            dnn_version_info {{ major: 9 minor: 10 patch: 0 }}
            device_description_str: "{self.kind}"
        """


CARDS = {
    "H100": Card(
        kind="NVIDIA H100 80GB HBM3",
        capability=(9, 0),
        cores=132,
        fp32_per_core=128,
        bandwidth=3_352_320_000_000,
        memory=84_942_979_072,
        l2=52_428_800,
        shared_per_core=233_472,
        shared_per_block=232_448,
        clock=1.98,
    ),
    "A100": Card(
        kind="NVIDIA A100-SXM4-80GB",
        capability=(8, 0),
        cores=108,
        fp32_per_core=64,
        bandwidth=2_039_000_000_000,
        memory=85_094_825_984,
        l2=41_943_040,
        shared_per_core=167_936,
        shared_per_block=166_912,
        clock=1.41,
    ),
}
"""Name -> card."""

TPU_TOPOLOGY = "v5e:2x2"
"""The smallest TPU v5e that XLA knows by name; programs are compiled for one of its chips."""

TPU_ENVIRON = {
    "TPU_SKIP_MDS_QUERY": "1",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "TPU_ACCELERATOR_TYPE": "v5litepod-4",
}
"""What libtpu otherwise asks a cloud's server for."""
