# find_package(palpate) gives palpate::palpate: the header palpate.hpp, and libpalpate. Installed by `make install`.
get_filename_component(PALPATE_PREFIX "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
find_library(PALPATE_LIBRARY palpate PATHS "${PALPATE_PREFIX}/lib" NO_DEFAULT_PATH)
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
endif()
