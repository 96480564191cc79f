# Puts the built extension beside the Python source too, so that tests run on the source tree of a clone find it.
# Renamed into place, so that a process that has the old one open keeps it. A read-only tree is left alone.
execute_process(COMMAND ${CMAKE_COMMAND} -E copy ${FROM} ${TO}/.placing RESULT_VARIABLE failed ERROR_QUIET)
if(NOT failed)
  get_filename_component(name ${FROM} NAME)
  execute_process(COMMAND ${CMAKE_COMMAND} -E rename ${TO}/.placing ${TO}/${name} ERROR_QUIET)
endif()
