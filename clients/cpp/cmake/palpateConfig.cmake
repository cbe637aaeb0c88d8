# find_package(palpate) gives palpate::palpate: the header palpate.hpp, and libpalpate. `make install` and the
# package of libpalpate for Windows have it.
get_filename_component(PALPATE_PREFIX "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
if(WIN32)
  # Programs load palpate.dll, and link with an import library: MSVC's palpate.lib, MinGW's libpalpate.dll.a. These are files by
  # name, because a toolchain for another system makes find_library look below its own root.
  set(PALPATE_IMPORTS "${PALPATE_PREFIX}/lib/libpalpate.dll.a")
  if(MSVC)
    set(PALPATE_IMPORTS "${PALPATE_PREFIX}/lib/palpate.lib")
  endif()
  set(PALPATE_LIBRARY "${PALPATE_PREFIX}/bin/palpate.dll")
  foreach(file "${PALPATE_LIBRARY}" "${PALPATE_IMPORTS}")
    if(NOT EXISTS "${file}")
      set(palpate_FOUND FALSE)
      set(palpate_NOT_FOUND_MESSAGE "there is no ${file}")
      return()
    endif()
  endforeach()
else()
  find_library(PALPATE_LIBRARY palpate PATHS "${PALPATE_PREFIX}/lib" NO_DEFAULT_PATH)
endif()
if(NOT PALPATE_LIBRARY)
  set(palpate_FOUND FALSE)
  set(palpate_NOT_FOUND_MESSAGE "no libpalpate in ${PALPATE_PREFIX}/lib: make install PREFIX=${PALPATE_PREFIX}")
  return()
endif()
if(NOT TARGET palpate::palpate)
  add_library(palpate::palpate SHARED IMPORTED)
  set_target_properties(palpate::palpate PROPERTIES
    IMPORTED_LOCATION "${PALPATE_LIBRARY}"
    INTERFACE_INCLUDE_DIRECTORIES "${PALPATE_PREFIX}/include"
    INTERFACE_COMPILE_FEATURES cxx_std_17)
  if(WIN32)
    set_target_properties(palpate::palpate PROPERTIES IMPORTED_IMPLIB "${PALPATE_IMPORTS}")
  endif()
endif()
