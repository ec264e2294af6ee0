/* Functions of FMI 3.0 for what this model does not have: other types, clocks, dependencies, serial states. */

#define NAMES const fmi3ValueReference references[], size_t n
#define REFUSED(what) { return fail(c, "this model has no " what); }
#define SILENCE (void)references, (void)n, (void)values

#define TYPE(name, type) \
    FMI3(fmi3Status) fmi3Get##name(fmi3Instance c, NAMES, type values[], size_t count) { \
        SILENCE; \
        return n || count ? fail(c, "this model has no variables of type " #name) : fmi3OK; \
    } \
    FMI3(fmi3Status) fmi3Set##name(fmi3Instance c, NAMES, const type values[], size_t count) { \
        SILENCE; \
        return n || count ? fail(c, "this model has no variables of type " #name) : fmi3OK; \
    }
TYPE(Float32, fmi3Float32)
TYPE(Int8, fmi3Int8)
TYPE(UInt8, fmi3UInt8)
TYPE(Int16, fmi3Int16)
TYPE(UInt16, fmi3UInt16)
TYPE(Int32, fmi3Int32)
TYPE(UInt32, fmi3UInt32)
TYPE(Int64, fmi3Int64)
TYPE(UInt64, fmi3UInt64)
TYPE(Boolean, fmi3Boolean)
TYPE(String, fmi3String)

#ifdef __GNUC__
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

FMI3(fmi3Status) fmi3GetBinary(fmi3Instance c, NAMES, size_t sizes[], fmi3Binary values[], size_t count)
REFUSED("binary variables")
FMI3(fmi3Status) fmi3SetBinary(fmi3Instance c, NAMES, const size_t sizes[], const fmi3Binary values[], size_t count)
REFUSED("binary variables")
FMI3(fmi3Status) fmi3GetClock(fmi3Instance c, NAMES, fmi3Clock values[]) REFUSED("clocks")
FMI3(fmi3Status) fmi3SetClock(fmi3Instance c, NAMES, const fmi3Clock values[]) REFUSED("clocks")
FMI3(fmi3Status) fmi3GetIntervalDecimal(fmi3Instance c, NAMES, fmi3Float64 intervals[], fmi3IntervalQualifier kinds[])
REFUSED("clocks")
FMI3(fmi3Status) fmi3GetIntervalFraction(fmi3Instance c, NAMES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                         fmi3IntervalQualifier kinds[])
REFUSED("clocks")
FMI3(fmi3Status) fmi3GetShiftDecimal(fmi3Instance c, NAMES, fmi3Float64 shifts[]) REFUSED("clocks")
FMI3(fmi3Status) fmi3GetShiftFraction(fmi3Instance c, NAMES, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
REFUSED("clocks")
FMI3(fmi3Status) fmi3SetIntervalDecimal(fmi3Instance c, NAMES, const fmi3Float64 intervals[]) REFUSED("clocks")
FMI3(fmi3Status) fmi3SetIntervalFraction(fmi3Instance c, NAMES, const fmi3UInt64 counters[],
                                         const fmi3UInt64 resolutions[])
REFUSED("clocks")
FMI3(fmi3Status) fmi3SetShiftDecimal(fmi3Instance c, NAMES, const fmi3Float64 shifts[]) REFUSED("clocks")
FMI3(fmi3Status) fmi3SetShiftFraction(fmi3Instance c, NAMES, const fmi3UInt64 counters[],
                                      const fmi3UInt64 resolutions[])
REFUSED("clocks")
FMI3(fmi3Status) fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
REFUSED("clocks")
FMI3(fmi3Status) fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference reference, size_t *n)
REFUSED("list of dependencies")
FMI3(fmi3Status) fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent, size_t elements[],
                                             fmi3ValueReference independents[], size_t theirs[],
                                             fmi3DependencyKind kinds[], size_t n)
REFUSED("list of dependencies")
FMI3(fmi3Status) fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) REFUSED("serial states")
FMI3(fmi3Status) fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
REFUSED("serial states")
FMI3(fmi3Status) fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
REFUSED("serial states")
FMI3(fmi3Status) fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n,
                                              const fmi3ValueReference knowns[], size_t m, const fmi3Float64 seed[],
                                              size_t s, fmi3Float64 values[], size_t count)
REFUSED("directional derivatives")
FMI3(fmi3Status) fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n,
                                          const fmi3ValueReference knowns[], size_t m, const fmi3Float64 seed[],
                                          size_t s, fmi3Float64 values[], size_t count)
REFUSED("adjoint derivatives")
FMI3(fmi3Status) fmi3GetOutputDerivatives(fmi3Instance c, NAMES, const fmi3Int32 orders[], fmi3Float64 values[],
                                          size_t count)
REFUSED("output derivatives")
FMI3(fmi3Instance)
fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                  fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                  fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
                                  fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock) {
    if (log) log(environment, fmi3Error, "logStatusError", "this model has no clocks and no scheduled execution");
    return NULL;
}

#ifdef __GNUC__
#pragma GCC diagnostic pop
#endif
