"""Options of XLA that trade the speed of a program for the time that it takes to compile."""

#: For programs of many small operations: XLA's newer code generator takes a third longer to compile
#: them and they run no faster. (Matrix products do.)
QUICK_COMPILATION = {"xla_cpu_use_fusion_emitters": False}

#: For programs that run a few hundred times at most: a sixth to a half off the time to compile, and
#: more to run, the more the larger the program.
QUICKEST_COMPILATION = QUICK_COMPILATION | {
    "xla_backend_optimization_level": 1,
    "xla_llvm_disable_expensive_passes": True,
}

#: the random generator that XLA compiles fastest
GENERATOR = "unsafe_rbg"
