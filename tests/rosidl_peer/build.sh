#!/usr/bin/env bash
# Builds this package's messages, bond's and tf2_msgs', with the real rosidl, in a virtual environment.
#
#   tests/rosidl_peer/build.sh [--program] [FOLDER]
#
# Prints the path of a file to source: with it python3 has rclpy and all message packages, and colcon finds
# ROS. FOLDER, for the environment and what is built, is $CARGO_TARGET_DIR/ros (target/ros) unless given;
# BOM_PEER_VENV names an environment to share. Does nothing when nothing has changed; safe to call at the same time.
# --program: the whole package with colcon, the program by cargo in $CARGO_TARGET_DIR; what is installed is run.
# Needs Python 3.11 with its headers, g++, make and OpenSSL's headers.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
repository=$(cd "$here/../.." && pwd)
program=OFF
if [ "${1:-}" = --program ]; then
    program=ON
    shift
fi
target=${CARGO_TARGET_DIR:-$repository/target}
mkdir -p "$target"
target=$(cd "$target" && pwd)
folder=${1:-$target/ros}
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
venv=${BOM_PEER_VENV:-$folder/venv}
environment=$folder/environment.sh

exec {lock}>"$folder/lock"
flock "$lock"

cd "$repository"
inputs=(msg srv CMakeLists.txt package.xml tests/rosidl_peer/bond tests/rosidl_peer/tf2_msgs)
inputs+=(tests/rosidl_peer/requirements.txt tests/rosidl_peer/build.sh)
wanted=$({
    echo "$venv"
    find "${inputs[@]}" -type f -print0 | sort -z | xargs -0 sha256sum
} | sha256sum)
if [ "$program" = OFF ] && [ -f "$folder/built" ] && [ "$(cat "$folder/built")" = "$wanted" ]; then
    echo "$environment"
    exit 0
fi
rm -f "$folder/built"

exec 3>&1 1>&2
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -r "$here/requirements.txt"

# The wheels were built under /opt/python; their CMake files say so.
include=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
numpy=$("$venv/bin/python" -c 'import numpy; print(numpy.get_include())')
{ grep -rlIZ '/opt/python/' "$venv"/share/*/cmake || true; } | xargs -0 -r sed -i \
    -e "s#/opt/python/[^/;\"]*/lib/python3[.0-9]*/site-packages/numpy/_core/include#$numpy#g" \
    -e "s#/opt/python/[^/;\"]*/include/python3[.0-9]*#$include#g" \
    -e "s#/opt/python/[^/;\"]*#$venv#g"

site=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
libraries=$venv/lib
for bundled in "$site"/*.libs; do libraries+=:$bundled; done
prefixes=$venv paths=
for package in bond tf2_msgs bayesian_object_models; do
    installed=$folder/install/$package
    prefixes=$installed:$prefixes
    paths+=$installed/${site#"$venv/"}:
    libraries=$installed/lib:$libraries
done
cat >"$environment" <<END
export PATH="$venv/bin:\$PATH"
export AMENT_PREFIX_PATH="$prefixes"
export CMAKE_PREFIX_PATH="$prefixes"
export PYTHONPATH="${paths%:}"
export LD_LIBRARY_PATH="$libraries\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}"
export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3 RMW_IMPLEMENTATION=rmw_fastrtps_cpp
END

# CMake refuses include folders that are inside the sources, as those of an environment in target/ are: by this
# name the sources are beside it.
ln -sfn "$repository" "$folder/source"

(
    source "$environment"
    # Not yet there: colcon would warn of it.
    export AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv PYTHONPATH=
    colcon --log-base "$folder/log" build \
        --base-paths "$folder/source" "$here/bond" "$here/tf2_msgs" --packages-select bond tf2_msgs bayesian_object_models \
        --build-base "$folder/build" --install-base "$folder/install" --event-handlers console_direct- \
        --cmake-args "-DBOM_BUILD_PROGRAM=$program" "-DBOM_CARGO_TARGET_DIR=$target" \
        -DBUILD_TESTING=OFF -DCMAKE_CXX_FLAGS=-O0 -DCMAKE_C_FLAGS=-O0 \
        "-DPython3_EXECUTABLE=$venv/bin/python" "-DPYTHON_EXECUTABLE=$venv/bin/python"
)
(source "$environment" && python3 -c 'import bayesian_object_models.msg, bayesian_object_models.srv, bond.msg, tf2_msgs.msg')
if [ "$program" = ON ]; then
    installed=$folder/install/bayesian_object_models
    "$installed/lib/bayesian_object_models/bom" --help
    for file in msg/ObjectPosterior.msg srv/Predict.srv config/default.yaml rviz/bom.rviz foxglove/bom.json; do
        [ -s "$installed/share/bayesian_object_models/$file" ]
    done
fi
echo "$wanted" >"$folder/built"
echo "$environment" >&3
