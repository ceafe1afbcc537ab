// Nothing: CMake precompiles headers of targets that have a source.
