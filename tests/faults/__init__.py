"""The faults of real machines, made on purpose: each must end in the bytes of an undisturbed run, or a clear refusal.

python -m tests.faults --all      every fault, in full; some need root (a small file system is mounted)
python -m tests.faults            the quick subset, which the ordinary tests run too
python -m tests.faults NAME ...   some of them, in full
"""
