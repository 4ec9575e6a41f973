// What Python calls of bundles with unknown points.
#include "bundles.h"

extern "C" __attribute__((visibility("default"))) const Entry *bundles() {
    static constexpr Entry table[] = {
        entry<bundle_rows>("bundle_rows"), entry<block_squares>("block_squares"), entry<add_direct>("add_direct"),
        entry<reduce_points>("reduce_points"), entry<pose_rows>("pose_rows"), entry<fill_upper>("fill_upper"),
        entry<symmetric_rows>("symmetric_rows"), entry<between_poses>("between_poses"),
        entry<back_substitute>("back_substitute"), entry<of_points>("of_points"),
        entry<point_from_local>("point_from_local"), entry<with_poses>("with_poses"), entry<with_lenses>("with_lenses"),
        entry<reduced_influence>("reduced_influence"), entry<direct_influence>("direct_influence"), {nullptr, nullptr, nullptr}};
    return table;
}
