// What Python calls of navigation from beacons, and of networks of measured pairs: their rows, elimination and loops.
#include "loops.h"
#include "navigation.h"
#include "pairs.h"
#include "reflections.h"
#include "search.h"

extern "C" __attribute__((visibility("default"))) const Entry *navigation() {
    static constexpr Entry table[] = {
        entry<spot_rows>("spot_rows"), entry<gauss_newton>("gauss_newton"), entry<some_pose>("some_pose"),
        entry<three_point_problem>("three_point_poses"), entry<search>("search"), entry<horton_loops>("horton_loops"),
        entry<label_chords>("label_chords"), entry<shortest_loop>("shortest_loop"),
        entry<pair_jacobians>("pair_jacobians"), entry<pair_rows>("pair_rows"), entry<pair_gradient>("pair_gradient"),
        entry<sure_forms>("sure_forms"), entry<pair_spread>("pair_spread"),
        entry<elimination_tree>("elimination_tree"), entry<gather_cliques>("gather_cliques"), entry<clique_nodes>("clique_nodes"),
        entry<elimination_room>("elimination_room"), entry<eliminate>("eliminate"), entry<solve_poses>("solve_poses"),
        entry<eliminate_rows>("eliminate_rows"), entry<compose_poses>("compose_poses"), entry<right_jacobians>("right_jacobians"), {nullptr, nullptr, nullptr}};
    return table;
}
