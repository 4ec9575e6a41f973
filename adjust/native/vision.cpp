// What Python calls of the fits of corners and spots, of boards, and of the renderer.
#include "boards.h"
#include "corners.h"
#include "grids.h"
#include "rendering.h"
#include "spots.h"

extern "C" __attribute__((visibility("default"))) const Entry *vision() {
    static constexpr Entry table[] = {
        entry<refine_corners>("refine_corners"), entry<corner_rows>("corner_rows"), entry<fit_spots>("fit_spots"),
        entry<spot_profile>("spot_rows_of_profile"), entry<pixel_corner_rays>("pixel_corner_rays"),
        entry<draw_facets>("draw_facets"), entry<spread_and_sum>("spread_and_sum"), entry<of_neighbours>("of_neighbours"),
        entry<first_is_dark>("first_is_dark"), entry<squares_follow>("squares_follow"), entry<may_go_on>("may_go_on"),
        entry<off_grid>("off_grid"), entry<unbend>("unbend"), entry<find_grid>("find_grid"),
        entry<count_crossings>("count_crossings"), {nullptr, nullptr, nullptr}};
    return table;
}
