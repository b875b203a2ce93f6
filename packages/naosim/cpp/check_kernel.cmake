# Fails if loading a kernel runs code, which a processor without its instructions cannot; OBJDUMP and OBJECT are given.
execute_process(COMMAND "${OBJDUMP}" -h "${OBJECT}" OUTPUT_VARIABLE sections RESULT_VARIABLE failed)
if(failed)
  message(FATAL_ERROR "${OBJECT}: objdump: ${failed}")
elseif(sections MATCHES "init_array|\\.ctors")
  message(FATAL_ERROR "${OBJECT}: something is initialized when the library is loaded; make it constexpr")
endif()
