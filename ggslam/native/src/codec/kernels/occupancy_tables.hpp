// SPDX-License-Identifier: Apache-2.0
// Constants of occupancy coding (ISO/IEC 23090-9, first edition). A neighbour pattern has a bit for each occupied face
// neighbour: +1 x + 1, +2 x - 1, +4 y - 1, +8 y + 1, +16 z - 1, +32 z + 1.
#pragma once
#include <cstdint>

namespace ggslam::GGSLAM_ISA::codec {

// By pattern: where each child goes when the pattern is turned into the representative of its class.
inline constexpr const char* kOctantPermutation[64] = {
    "01234567", "01234567", "67452301", "01234567", "45016723", "45016723", "67452301", "23670145",
    "23670145", "01234567", "23670145", "45016723", "23670145", "67452301", "01234567", "01234567",
    "51734062", "31207564", "64752031", "15043726", "75316420", "54107632", "76543210", "32761054",
    "20643175", "10325476", "32761054", "54107632", "04261537", "76543210", "10325476", "10325476",
    "15370426", "13025746", "46570213", "51407362", "57134602", "45016723", "67452301", "23670145",
    "02461357", "01234567", "23670145", "45016723", "40625173", "67452301", "01234567", "01234567",
    "15370426", "75643120", "20316475", "13025746", "31752064", "02461357", "13025746", "37261504",
    "64207531", "46570213", "57134602", "04152637", "02461357", "26043715", "15370426", "01234567"};

// By pattern: its class, with neighbours looked up (sorted counts per axis) and with siblings only.
inline constexpr std::uint8_t kPatternClass[64] = {
    0, 1, 1, 1, 1, 2, 2, 3, 1, 2, 2, 3, 1, 3, 3, 4, 1, 2, 2, 3, 2, 5, 5, 6, 2, 5, 5, 6, 3, 6, 6, 7, 1, 2, 2, 3, 2, 5,
    5, 6, 2, 5, 5, 6, 3, 6, 6, 7, 1, 3, 3, 4, 3, 6, 6, 7, 3, 6, 6, 7, 4, 7, 7, 8};
inline constexpr std::uint8_t kSiblingPatternClass[64] = {
    0, 5, 5, 0, 5, 1, 1, 0, 5, 1, 1, 0, 0, 0, 0, 0, 2, 3, 3, 0, 3, 7, 7, 0, 3, 7, 7, 0, 0, 0, 0, 0, 2, 3, 3, 0, 3, 7,
    7, 0, 3, 7, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};

// Coarser classes for the last bins, which have more bins before them to tell them apart.
inline constexpr std::uint8_t kClassOfFive[9] = {0, 1, 2, 3, 1, 2, 3, 4, 4};
inline constexpr std::uint8_t kClassOfThree[9] = {0, 1, 1, 2, 2, 1, 2, 2, 2};

// The bins of a (turned) occupancy byte in the order in which they are coded.
inline constexpr std::uint8_t kBinOrder[8] = {1, 7, 5, 3, 2, 6, 4, 0};

// Steps of the context maps by the distance from the end they move to.
inline constexpr std::uint8_t kMapStep[16] = {0, 1, 1, 2, 4, 7, 9, 11, 14, 16, 19, 23, 22, 18, 13, 6};

// Sizes of the maps of the eight bins are 9, 18, 35, 68, 69, 134, 135, 136.
inline constexpr int kMapStart[9] = {0, 9, 27, 62, 130, 199, 333, 468, 604};

}  // namespace ggslam::GGSLAM_ISA::codec
