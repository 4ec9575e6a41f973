// What Python calls of navigation from beacons, and of loops.
#include "loops.h"
#include "navigation.h"
#include "search.h"

extern "C" __attribute__((visibility("default"))) const Entry *navigation() {
    static constexpr Entry table[] = {
        entry<spot_rows>("spot_rows"), entry<gauss_newton>("gauss_newton"), entry<some_pose>("some_pose"),
        entry<roots_of_octic>("real_roots"),
        entry<three_point_problem>("three_point_poses"), entry<search>("search"), entry<horton_loops>("horton_loops"), {nullptr, nullptr, nullptr}};
    return table;
}
