# Source this file from sh, bash or zsh: . setup/env.sh
# It gives the shell ROS 2, the packages of this checkout and the command cmp_tactile.
# CMP_TACTILE_ROS=jazzy set before chooses the environment that 'make build ROS=jazzy' has made.
# A shell that cannot tell where a sourced file lies (dash) needs CMP_TACTILE_ROOT, or to be in the
# checkout's folder.

if [ -n "${BASH_SOURCE:-}" ]; then
    _cmp_tactile_root=$(CDPATH='' cd -- "$(dirname -- "$BASH_SOURCE")/.." && pwd -P)
elif [ -n "${ZSH_VERSION:-}" ]; then
    _cmp_tactile_root=$(eval 'CDPATH= cd -- "${${(%):-%x}:A:h}/.." && pwd -P')
else
    _cmp_tactile_root=$(CDPATH='' cd -- "${CMP_TACTILE_ROOT:-.}" && pwd -P)
fi

case "${CMP_TACTILE_ROS:-kilted}" in
    kilted) _cmp_tactile_install=install ;;
    *) _cmp_tactile_install=install-$CMP_TACTILE_ROS ;;
esac
if [ ! -f "$_cmp_tactile_root/$_cmp_tactile_install/cmp_tactile_environment.sh" ]; then
    echo "cmp_tactile: $_cmp_tactile_root is not set up${CMP_TACTILE_ROS:+ for $CMP_TACTILE_ROS}: run 'make build${CMP_TACTILE_ROS:+ ROS=$CMP_TACTILE_ROS}' there first" >&2
    unset _cmp_tactile_root _cmp_tactile_install
    return 1
fi
. "$_cmp_tactile_root/$_cmp_tactile_install/cmp_tactile_environment.sh"
unset _cmp_tactile_install
if [ "$CMP_TACTILE_BUILT_AT" != "$_cmp_tactile_root" ]; then
    echo "cmp_tactile: $_cmp_tactile_root was set up at $CMP_TACTILE_BUILT_AT: run 'make clean' and 'make build'" >&2
    unset _cmp_tactile_root CMP_TACTILE_BUILT_AT
    return 1
fi
unset _cmp_tactile_root CMP_TACTILE_BUILT_AT
