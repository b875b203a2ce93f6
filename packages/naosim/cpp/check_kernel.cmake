# A kernel is chosen at run time, so loading one may not run code: a processor without its instructions would end there.
if(NOT CMAKE_SCRIPT_MODE_FILE)
  # Checks the object library `kernel` before `library`, which holds it, is linked.
  function(check_kernel library kernel)
    if(CMAKE_OBJDUMP)
      add_custom_command(TARGET ${library} PRE_LINK VERBATIM COMMAND "${CMAKE_COMMAND}" -DOBJDUMP=${CMAKE_OBJDUMP}
        -DOBJECT=$<TARGET_OBJECTS:${kernel}> -P "${CMAKE_CURRENT_FUNCTION_LIST_FILE}")
    endif()
  endfunction()
  return()
endif()

execute_process(COMMAND "${OBJDUMP}" -h "${OBJECT}" OUTPUT_VARIABLE sections RESULT_VARIABLE failed)
if(failed)
  message(FATAL_ERROR "${OBJECT}: objdump: ${failed}")
elseif(sections MATCHES "init_array|\\.ctors")
  message(FATAL_ERROR "${OBJECT}: something is initialized when the library is loaded; make it constexpr")
endif()
