"""placeholder until the real one stands here"""
import os
if "NPROC" not in os.environ and (os.cpu_count() or 1) < 4:
    os.environ["NPROC"] = "4"
def configure_jax():
    import jax
    jax.config.update("jax_enable_x64", True)
