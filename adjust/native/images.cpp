// What Python calls of lenses, image points, views, planes, trees, reduced poses and simulated networks.
#include "calibration.h"
#include "chains.h"
#include "changes.h"
#include "condensed.h"
#include "parallels.h"
#include "planes.h"
#include "point_tests.h"
#include "text.h"
#include "reduction.h"

extern "C" __attribute__((visibility("default"))) const Entry *images() {
    static constexpr Entry table[] = {
        entry<evaluate_chains>("evaluate_chains"), entry<lens_rows>("lens_rows"), entry<rays_of>("rays_of"),
        entry<image_points_of>("image_points_of"), entry<radii_of>("radii_of"), entry<normal_equations>("normal_equations"),
        entry<errors>("errors"), entry<square_roots>("square_roots"), entry<point_columns>("point_columns"),
        entry<block_rows>("block_rows"), entry<condensed_rows>("condensed_rows"), entry<serve>("serve"), entry<local_by_keys>("local_by_keys"),
        entry<all_statistics>("all_statistics"), entry<reduce_poses>("reduce_poses"), entry<pose_steps>("pose_steps"),
        entry<leaf_rows>("leaf_rows"), entry<tree_block>("tree_block"), entry<invert_cliques>("invert_cliques"), entry<inversion_room>("inversion_room"),
        entry<covariance_room>("covariance_room"), entry<covariance_rows>("covariance_rows"), entry<clique_covariance>("clique_covariance"),
        entry<joint_blocks>("joint_blocks"), entry<solution_room>("solution_room"),
        entry<solve_cliques>("solve_cliques"), entry<sets_room>("sets_room"), entry<sets_among>("sets_among"),
        entry<refine_views>("refine_views"), entry<errors_of_views>("errors_of_views"),
        entry<offsets_of_views>("offsets_of_views"), entry<homographies>("homographies"),
        entry<plane_poses>("plane_poses"), entry<fit_lens>("fit_lens"), entry<turns_by>("turns_by"),
        entry<turns_of>("turns_of"), entry<row_influences>("row_influences"), entry<residual_tests>("residual_tests"),
        entry<sums_of_blocks>("sums_of_blocks"), entry<farthest_points>("farthest_points"),
        entry<controlled_directions>("controlled_directions"), entry<external_reliability>("external_reliability"), entry<point_tests>("point_tests"), entry<change_squares>("change_squares"),
        entry<parallel_pairs>("parallel_pairs"),
        entry<number_rows>("number_rows"), entry<record_rows>("record_rows"), {nullptr, nullptr, nullptr}};
    return table;
}
